"""Fit a template's neutral to the scan of a person: the person's own face on the template's topology.

SCAN is a mesh or a cloud of points (.ply .obj .glb .gltf .usd), of any pose and unit, whole or in part. Eyes, teeth
and what no scan shows follow the model of the database and the skin around. Landmarks (multipie68, in the scan's own
coordinates) are read from --landmarks, else from SCAN's name with .landmarks.json, else found on the scan, which needs
`pip install 'facepipe[train]'`. {"points": [[x, y, z] | null, ... 68]} names 6 or more of them.

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
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from facepipe.atomic import replacing
from facepipe.cli.parser import add_options, add_output, options_from, output_of, pairs, picture_of
from facepipe.cli.scan_input import landmark_file, landmarks_of, named
from facepipe.cli.scan_picture import draw_fit
from facepipe.cli.show import emit, progress, table, warn

if TYPE_CHECKING:
    from facepipe.processors.rebuild import NeutralFit, Template
    from facepipe.processors.rebuild.fit_neutral import NeutralReport
    from facepipe.scans import Scan
    from facepipe.stage import Face

_STEPS = 18  # of a fit, at most


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments."""
    from facepipe.processors.rebuild import FitNeutralOptions

    add = parser.add_argument
    add("scan", type=Path, metavar="SCAN", help="scan of the neutral: .ply .obj .glb .gltf .usda .usdc .usd .usdz")
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
    from facepipe.importers.scan_file import read_scan
    from facepipe.processors.database import QualityLimits, load_database, misses
    from facepipe.processors.rebuild import FitNeutral, FitNeutralOptions, Template
    from facepipe.stage import open_face

    file = landmark_file(arguments.scan, arguments.landmarks)
    weights = pairs(arguments.weights or [], "--weights")
    inputs = [arguments.scan, arguments.template, arguments.database, *([file] if file else [])]
    out = output_of(arguments, inputs)
    picture = None if arguments.picture is None else picture_of(arguments.picture, arguments, inputs, out)
    fit_neutral = FitNeutral(options=options_from(arguments, FitNeutralOptions))
    face = open_face(arguments.template)
    template = Template.of(face.parts(), str(arguments.template))
    database, scan = load_database(arguments.database), read_scan(arguments.scan)
    landmarks, found = landmarks_of(file, scan)
    with named(arguments.scan), progress("fit", _STEPS) as bar:
        fit = fit_neutral(template, scan, landmarks, database, lambda step: bar.update(), weights)
    authored = _author(_Request(arguments, file, weights, out, picture), face, template, scan, fit)
    report = fit.report
    missed = misses(report.quality, QualityLimits())
    warnings = [*found, *report.warnings, *authored, *missed]
    warn(warnings)
    result = {"path": str(out), **json.loads(report.to_json()), "warnings": warnings, "missed": list(missed)}
    lines = [_text(out, report)]
    if picture is not None:
        result["picture"] = str(picture)
        lines.append(str(picture))
    emit(result, "\n".join(lines), as_json=arguments.json)
    return 1 if missed else 0


class _Request(NamedTuple):
    """What was asked for, checked."""

    arguments: argparse.Namespace
    landmarks: Path | None
    weights: Mapping[str, float]
    out: Path
    picture: Path | None


def _author(request: _Request, face: Face, template: Template, scan: Scan, fit: NeutralFit) -> tuple[str, ...]:
    """Write the stage and the picture, or neither; what there is to say of it."""
    from facepipe.processors.rebuild import FitNeutralOptions
    from facepipe.processors.rebuild.author_neutral import AuthorNeutral
    from facepipe.processors.rebuild.neutral_recipe import neutral_recipe

    given = request.arguments
    options = options_from(given, FitNeutralOptions)
    recipe = neutral_recipe(
        given.template,
        given.scan,
        given.database,
        request.out,
        options,
        fit.report.quality,
        request.landmarks,
        request.weights,
        fit.report.weights,
    )
    with ExitStack() as files:
        picture = None if request.picture is None else files.enter_context(replacing(request.picture))
        derived = files.enter_context(face.deriving(request.out, flatten=given.flatten))
        with named(given.template):
            report = AuthorNeutral()(derived, fit.points, recipe=recipe)
        if picture is not None:
            neutral = fit.points if fit.report.weights else None
            draw_fit(picture, template, fit.points + fit.expression, scan, fit.place, neutral)
    return report.warnings


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
