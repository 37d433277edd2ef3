"""Fit a template's neutral to the scan of a person: the person's own face on the template's topology.

SCAN is a mesh or a cloud of points (.ply .obj .stl .off .glb .gltf or USD), of any pose and unit, whole or in part.
Eyes, teeth and what no scan shows follow the model of the database and the skin around. Landmarks (multipie68, in the
scan's own coordinates) are read from --landmarks, else from SCAN's name with .landmarks.json, else found on the scan,
which needs `pip install 'facepipe[train]'`. {"points": [[x, y, z] | null, ... 68]} names 6 or more of them.

The neutral has open eyes and a mouth at rest. Where SCAN shows something else, such as closed eyes, --weights says so
with the template's shapes; the neutral is without them, the picture with them.

OUT is an override layer over the template, whose blendshapes, rig, regions, materials and sliders it keeps; joints
move with the skin. --flatten writes a standalone file. --picture shows scan, face and their distance. Exit code 1:
done, but a limit of the quality gate of `facepipe database add` is missed.

examples:
  facepipe fit-neutral anna.ply --template head.usda --database faces.fpdb -o anna.usda --picture anna.png
  facepipe fit-neutral anna.glb --template head.usda --database faces.fpdb --landmarks marks.json --unit cm -o a.usda
  facepipe fit-neutral ben.ply --template head.usda --database faces.fpdb -o ben.usda \\
      --weights eyeBlinkLeft=1 eyeBlinkRight=1
"""

from __future__ import annotations

import argparse
import json
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.cli.parser import add_options, add_output, options_from, output_of, pairs, picture_of
from facepipe.cli.scan_picture import draw_fit
from facepipe.cli.show import emit, progress, warn
from facepipe.core.atomic import replacing, together
from facepipe.core.texts import table
from facepipe.pipeline.scan_input import landmark_file

if TYPE_CHECKING:
    from facepipe.pipeline.fit_neutral import NeutralJob
    from facepipe.pipeline.rebuild_stage import Made
    from facepipe.processors.rebuild import NeutralFit, Template
    from facepipe.processors.rebuild.fit_neutral import NeutralReport
    from facepipe.scans import Scan


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments."""
    from facepipe.processors.rebuild import FitNeutralOptions

    add = parser.add_argument
    add("scan", type=Path, metavar="SCAN", help="scan of the neutral: .ply .obj .stl .off .glb .gltf or USD")
    add("--template", type=Path, required=True, metavar="FACE", help="face stage with multipie68 landmarks")
    add("--database", type=Path, required=True, metavar="FPDB", help="faces of the template's topology: .fpdb")
    add("--landmarks", type=Path, metavar="JSON", help="landmarks of the scan (default SCAN's .landmarks.json)")
    text = "shapes that the scan shows besides the neutral, weights above 0 up to 2"
    add("--weights", nargs="+", action="extend", metavar="SHAPE=WEIGHT", help=text)
    add_output(parser, "override layer to write: .usda .usdc .usd .usdz")
    add("--flatten", action="store_true", help="write a standalone file")
    add("--picture", type=Path, metavar="PNG", help="draw scan, face and their distance")
    add("--json", action="store_true", help="print the report as JSON")
    add_options(parser, FitNeutralOptions, "how to fit")


def run(arguments: argparse.Namespace) -> int:
    """Read, fit, author, report."""
    from facepipe.pipeline.fit_neutral import NeutralJob
    from facepipe.processors.rebuild import FitNeutralOptions

    file = landmark_file(arguments.scan, arguments.landmarks)
    weights = pairs(arguments.weights or [], "--weights")
    inputs = [arguments.scan, arguments.template, arguments.database, *([file] if file else [])]
    out = output_of(arguments, inputs)
    picture = None if arguments.picture is None else picture_of(arguments.picture, arguments, inputs, out)
    job = NeutralJob(
        scan=arguments.scan,
        template=arguments.template,
        database=arguments.database,
        landmarks=file,
        out=out,
        weights=weights,
        options=options_from(arguments, FitNeutralOptions),
        flatten=arguments.flatten,
    )
    report, missed = _make(job, picture)
    warn(report.warnings)
    result = {"path": str(out), **json.loads(report.to_json()), "missed": list(missed)}
    lines = [_text(out, report)]
    if picture is not None:
        result["picture"] = str(picture)
        lines.append(str(picture))
    emit(result, "\n".join(lines), as_json=arguments.json)
    return 1 if missed else 0


def _make(job: NeutralJob, picture: Path | None) -> Made[NeutralReport]:
    """Write the stage and the picture, or neither."""
    from facepipe.pipeline.fit_neutral import make

    with together(job.out), ExitStack() as files:
        image = None if picture is None else files.enter_context(replacing(picture))

        def seen(template: Template, scan: Scan, fit: NeutralFit) -> None:
            if image is not None:
                neutral = fit.points if fit.report.weights else None
                draw_fit(image, template, fit.points + fit.expression, scan, fit.place, neutral)

        return make(job, progress, seen)


def _text(out: Path, report: NeutralReport) -> str:
    fit, quality = report.fit, report.quality
    unit = f"{fit.mm_per_unit:.4g} mm" + (f" ({fit.unit})" if fit.unit and fit.unit != "mm" else "")
    off = f", {len(fit.outliers)} of them lie off" if fit.outliers else ""
    shown = ", ".join(f"{shape} {weight:.2f}" for shape, weight in report.weights.items())
    rows = [
        (
            "distance from the scan",
            f"mean {quality.surface_mean_mm:.3f} mm, 95 % below {quality.surface_p95_mm:.3f} mm",
        ),
        ("face area that the scan shows", f"{100 * quality.coverage:.1f} %"),
        ("landmarks", f"{fit.landmark_mean_mm:.2f} mm off (mean){off}"),
        *([("shows besides", shown)] if shown else []),
        ("beyond the model", f"mean {report.residual_mean_mm:.2f} mm, at most {report.residual_max_mm:.2f} mm"),
        ("flipped triangles", f"{quality.flipped_triangles}"),
        ("a unit of the scan", unit),
        ("steps", f"{fit.steps}"),
    ]
    return "\n".join([str(out), table(rows)])
