"""Put a person's face on the scan of an expression: the whole expression as one shape over the personal template.

SCAN is a mesh or a cloud of points, of any pose and unit. What it shows is said by --weights, or by the name of a
composite (default: SCAN's name): jaw_open, smile, laugh, brows_up ... as docs/rebuild.md lists them. From there the
weights are found anew. Landmarks are read from --landmarks, else from SCAN's name with .landmarks.json, else found on
the scan, which needs `pip install 'facepipe[train]'`. With the neutral's scan, painted markers that both have are
followed, and scans of one size stay so.

OUT is an override layer over --personal with the expression as a shape called --name; `facepipe split-shapes` takes
it, as it is or corrected by hand. Exit code 1: done, but the face lies on the scan worse than the quality gate of
`facepipe database add` asks for, or the scan shows less of it.

examples:
  facepipe register-scan smile.ply --personal personal.usda -o work/smile.usda --picture smile.png
  facepipe register-scan take7.ply --personal personal.usda --name grin -o grin.usda \\
      --weights mouthSmileLeft=1 mouthSmileRight=1 jawOpen=0.2 --neutral-scan anna.ply
"""

from __future__ import annotations

import argparse
import json
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.cli.parser import add_options, add_output
from facepipe.cli.register_scan_request import Request, request_of
from facepipe.cli.show import emit, progress, warn
from facepipe.core.atomic import replacing, together
from facepipe.core.texts import table

if TYPE_CHECKING:
    from facepipe.pipeline.rebuild_stage import Made
    from facepipe.processors.rebuild import CompositeReport, RegisteredComposite, Template
    from facepipe.scans import Scan


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments."""
    from facepipe.processors.rebuild import RegisterScansOptions

    add = parser.add_argument
    add("scan", type=Path, metavar="SCAN", help="scan of an expression: .ply .obj .stl .off .glb .gltf or USD")
    add("--personal", type=Path, required=True, metavar="FACE", help="what `facepipe personal-template` made")
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--composite", metavar="NAME", help="what the scan shows, as the table of composites has it")
    text = "what the scan shows: shapes, weights above 0 up to 2"
    what.add_argument("--weights", nargs="+", action="extend", metavar="SHAPE=WEIGHT", help=text)
    add("--name", help="of the shape to author (default SCAN's name)")
    add("--landmarks", type=Path, metavar="JSON", help="landmarks of the scan (default SCAN's .landmarks.json)")
    add("--neutral-scan", type=Path, metavar="SCAN", help="scan that the neutral was fitted to")
    add("--neutral-landmarks", type=Path, metavar="JSON", help="its landmarks (default its .landmarks.json)")
    text = "what the neutral's scan shows besides, as `facepipe fit-neutral` found it"
    add("--neutral-weights", nargs="+", action="extend", metavar="SHAPE=WEIGHT", help=text)
    add_output(parser, "override layer to write: .usda .usdc .usd .usdz")
    add("--flatten", action="store_true", help="write a standalone file")
    add("--picture", type=Path, metavar="PNG", help="draw scan, face and their distance")
    add("--json", action="store_true", help="print the report as JSON")
    add_options(parser, RegisterScansOptions, "how to register")


def run(arguments: argparse.Namespace) -> int:
    """Read, register, author, report."""
    request = request_of(arguments)
    job = request.job
    report, missed = _make(request)
    warn(report.warnings)
    result = {"path": str(job.out), "name": job.name, **json.loads(report.to_json()), "missed": list(missed)}
    lines = [str(job.out), _text(job.name, report)]
    if request.picture is not None:
        result["picture"] = str(request.picture)
        lines.append(str(request.picture))
    emit(result, "\n".join(lines), as_json=arguments.json)
    return 1 if missed else 0


def _make(request: Request) -> Made[CompositeReport]:
    """Write the stage and the picture, or neither."""
    from facepipe.pipeline.register_scan import make
    from facepipe.processors.rebuild.scan_picture import draw_fit

    with together(request.job.out), ExitStack() as files:
        image = None if request.picture is None else files.enter_context(replacing(request.picture))

        def seen(template: Template, scan: Scan, composite: RegisteredComposite) -> None:
            if image is not None:
                draw_fit(image, template, composite.points, scan, composite.place)

        return make(request.job, progress, seen)


def _text(name: str, report: CompositeReport) -> str:
    fit = report.fit
    off = f", {len(fit.outliers)} of them lie off" if fit.outliers else ""
    beyond = f"mean {report.beyond_template_mean_mm:.2f} mm, at most {report.beyond_template_max_mm:.2f} mm"
    rows = [
        ("shape", name),
        ("weights", ", ".join(f"{shape} {weight:.2f}" for shape, weight in report.weights.items())),
        ("distance from the scan", f"mean {fit.surface_mean_mm:.3f} mm, 95 % below {fit.surface_p95_mm:.3f} mm"),
        ("face area that the scan shows", f"{100 * fit.coverage:.1f} %"),
        ("landmarks", f"{fit.landmark_mean_mm:.2f} mm off (mean){off}"),
        ("from the personal template's", beyond),
        ("steps", f"{fit.steps}"),
    ]
    return table(rows)
