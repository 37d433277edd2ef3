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

from facepipe.atomic import replacing
from facepipe.cli.parser import add_options, add_output, options_from
from facepipe.cli.register_scan_request import Request, request_of
from facepipe.cli.scan_input import landmarks_of, named
from facepipe.cli.scan_picture import draw_fit
from facepipe.cli.show import emit, progress, table, warn

if TYPE_CHECKING:
    from facepipe.parts import FloatArray, Recipe
    from facepipe.processors.database import WholeFace
    from facepipe.processors.rebuild import CompositeReport, NeutralScan, RegisteredComposite, Template
    from facepipe.scans import Scan
    from facepipe.stage import Face

_STEPS = 18  # of a registration, at most


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments."""
    from facepipe.processors.rebuild import RegisterScansOptions

    add = parser.add_argument
    add("scan", type=Path, metavar="SCAN", help="scan of an expression: .ply .obj .glb .gltf .usda .usdc .usd .usdz")
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
    from facepipe.importers.scan_file import read_scan
    from facepipe.processors.database import whole_face
    from facepipe.processors.rebuild import ExpressionScan, RegisterScans, RegisterScansOptions, Template
    from facepipe.stage import open_face

    request = request_of(arguments)
    register = RegisterScans(options=options_from(arguments, RegisterScansOptions))
    face = open_face(request.personal)
    parts = face.parts()
    own = whole_face(parts, str(request.personal))
    weights = request.resolved(tuple(own.deltas))
    template = Template.of(parts, str(request.personal))
    scan = read_scan(request.scan)
    landmarks, found = landmarks_of(request.landmarks, scan)
    neutral, told = _neutral(request, template, own)
    given = ExpressionScan(scan=scan, landmarks=landmarks, weights=weights)
    with named(request.scan), progress("register", _STEPS) as bar:
        composite = register(template, neutral, own.deltas, given, lambda step: bar.update())
        missed = _misses(composite.report)
    recipe = request.recipe(register.options, weights, composite.weights, composite.report.fit)
    authored = _author(request, face, template, own.points, scan, composite, recipe)
    unused = ("markers don't count without --neutral-scan",) if landmarks.markers and neutral.place is None else ()
    warnings = [*found, *told, *unused, *composite.report.warnings, *authored, *missed]
    warn(warnings)
    result = {"path": str(request.out), "name": request.name, **json.loads(composite.report.to_json())}
    result |= {"warnings": warnings, "missed": list(missed)}
    lines = [str(request.out), _text(request.name, composite.report)]
    if request.picture is not None:
        result["picture"] = str(request.picture)
        lines.append(str(request.picture))
    emit(result, "\n".join(lines), as_json=arguments.json)
    return 1 if missed else 0


def _neutral(request: Request, template: Template, own: WholeFace) -> tuple[NeutralScan, tuple[str, ...]]:
    """The neutral, with the place of its scan where one is given, and what there is to say of that."""
    from facepipe.importers.scan_file import read_scan
    from facepipe.processors.rebuild import NeutralScan, resolved
    from facepipe.processors.rebuild.neutral_place import placed_neutral
    from facepipe.processors.rebuild.shown_shapes import ShownShapes

    if request.neutral_scan is None:
        return NeutralScan(points=own.points), ()
    expression = None
    if request.neutral_weights:
        shown = resolved(request.neutral_weights, tuple(own.deltas), "--neutral-weights")
        expression = ShownShapes(deltas=own.deltas, weights=shown).expression(shown, len(own.points))
    scan = read_scan(request.neutral_scan)
    landmarks, found = landmarks_of(request.neutral_landmarks, scan)
    with named(request.neutral_scan):
        return placed_neutral(template, own.points, scan, landmarks, expression), found


def _author(
    request: Request,
    face: Face,
    template: Template,
    neutral: FloatArray,
    scan: Scan,
    composite: RegisteredComposite,
    recipe: Recipe,
) -> tuple[str, ...]:
    """Write the stage and the picture, or neither; what there is to say of it."""
    from facepipe.processors.rebuild.expression_file import author_expression

    with ExitStack() as files:
        picture = None if request.picture is None else files.enter_context(replacing(request.picture))
        derived = files.enter_context(face.deriving(request.out, flatten=request.flatten))
        with named(request.personal):
            report = author_expression(derived, request.name, neutral, composite, recipe)
        if picture is not None:
            draw_fit(picture, template, composite.points, scan, composite.place)
    return report.warnings


def _misses(report: CompositeReport) -> tuple[str, ...]:
    from facepipe.processors.database import Quality, QualityLimits, misses

    fit = report.fit
    quality = Quality(
        surface_mean_mm=fit.surface_mean_mm,
        surface_p95_mm=fit.surface_p95_mm,
        coverage=fit.coverage,
        flipped_triangles=0,  # those are counted of shapes
    )
    return misses(quality, QualityLimits())


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
