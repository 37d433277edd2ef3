"""Draw a neutral, or regions of it, closer to its scan.

NEUTRAL is a face stage of `facepipe fit-neutral`, corrected by hand or not; SCAN is the scan that it was fitted to. The
scan is placed on the neutral by landmarks, then by the surface; landmarks are read from --landmarks, else from SCAN's
name with .landmarks.json, else found on the scan, which needs `pip install 'facepipe[train]'`. Then points go to the
scan, each triangle changed like its neighbours.

--region names soft masks of the face (`facepipe regions` lists them): points outside stay exactly where they are, those
at the border go part of the way. Without it all of the face may follow. Eyes and teeth go with the skin around them
where they are in the region. What SCAN shows besides the neutral, such as closed eyes, NEUTRAL's recipe tells where
`facepipe fit-neutral --weights` was told; else --weights says so.

OUT is an override layer over NEUTRAL; --flatten writes a standalone file. Exit code 1: done, but a limit of the quality
gate of `facepipe database add` is missed.

examples:
  facepipe refine-neutral anna.usda anna.ply -o refined.usda --region nose --picture refined.png
  facepipe refine-neutral anna.usda anna.ply -o refined.usda --region nose mouth --detail-mm 6
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
    from facepipe.parts import FaceParts, FloatArray, Recipe
    from facepipe.processors.rebuild import RefinedNeutral, RefineReport, Template
    from facepipe.scans import Scan
    from facepipe.stage import Face

_STEPS = 16  # of a refinement, at most


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments."""
    from facepipe.processors.rebuild import RefineNeutralOptions

    add = parser.add_argument
    add("neutral", type=Path, metavar="NEUTRAL", help="face stage with the person's neutral")
    add("scan", type=Path, metavar="SCAN", help="its scan: .ply .obj .glb .gltf .usda .usdc .usd .usdz")
    add("--region", nargs="+", action="extend", default=[], metavar="NAME", help="what may follow (default all)")
    add("--landmarks", type=Path, metavar="JSON", help="landmarks of the scan (default SCAN's .landmarks.json)")
    text = "shapes that the scan shows besides the neutral, weights above 0 up to 2 (default as NEUTRAL was fitted)"
    add("--weights", nargs="+", action="extend", metavar="SHAPE=WEIGHT", help=text)
    add_output(parser, "override layer to write: .usda .usdc .usd .usdz")
    add("--flatten", action="store_true", help="write a standalone file")
    add("--picture", type=Path, metavar="PNG", help="draw scan, face and their distance")
    add("--json", action="store_true", help="print the report as JSON")
    add_options(parser, RefineNeutralOptions, "how to refine")


def run(arguments: argparse.Namespace) -> int:
    """Read, refine, author, report."""
    from facepipe.importers.scan_file import read_scan
    from facepipe.processors.rebuild import RefineNeutral, RefineNeutralOptions, Template
    from facepipe.processors.rebuild.neutral_recipe import flipped_before, refined_recipe, shown_before
    from facepipe.processors.rebuild.region_weights import region_weights
    from facepipe.stage import open_face

    file = landmark_file(arguments.scan, arguments.landmarks)
    inputs = [arguments.neutral, arguments.scan, *([file] if file else [])]
    out = output_of(arguments, inputs)
    picture = None if arguments.picture is None else picture_of(arguments.picture, arguments, inputs, out)
    refine = RefineNeutral(options=options_from(arguments, RefineNeutralOptions))
    face = open_face(arguments.neutral)
    parts = face.parts()
    weights = region_weights(parts, arguments.region, str(arguments.neutral))
    template = Template.of(parts, str(arguments.neutral))
    scan = read_scan(arguments.scan)
    landmarks, told = landmarks_of(file, scan)
    shown = pairs(arguments.weights, "--weights") if arguments.weights else shown_before(parts.recipe)
    expression, shown = _expression(parts, arguments.neutral, shown)
    with named(arguments.scan), progress("refine", _STEPS) as bar:
        found = refine(
            template,
            template.points,
            scan,
            landmarks,
            weights=weights,
            expression=expression,
            flipped=flipped_before(parts.recipe),
            progress=lambda step: bar.update(),
        )
    files = (arguments.neutral, arguments.scan, file)
    recipe = refined_recipe(*files, out, arguments.region, refine.options, found.report.quality, shown)
    request = _Request(arguments, out, picture, expression)
    authored = _author(request, face, template, scan, found, recipe)
    return _tell(request, found.report, (*told, *found.report.warnings, *authored))


class _Request(NamedTuple):
    """What was asked for, checked."""

    arguments: argparse.Namespace
    out: Path
    picture: Path | None
    expression: FloatArray


def _expression(parts: FaceParts, neutral: Path, shown: Mapping[str, float]) -> tuple[FloatArray, dict[str, float]]:
    """(n, 3) whole delta of what the scan shows besides, and its weights by the names of the face's shapes."""
    from facepipe.processors.database import whole_face
    from facepipe.processors.rebuild import resolved
    from facepipe.processors.rebuild.shown_shapes import ShownShapes

    own = whole_face(parts, str(neutral))
    weights = resolved(shown, tuple(own.deltas), f"{neutral} -> --weights") if shown else {}
    return ShownShapes(deltas=own.deltas, weights=weights).expression(weights, len(own.points)), weights


def _author(
    request: _Request, face: Face, template: Template, scan: Scan, found: RefinedNeutral, recipe: Recipe
) -> tuple[str, ...]:
    """Write the stage and the picture, or neither; what there is to say of it."""
    from facepipe.processors.rebuild.author_neutral import AuthorNeutral

    given = request.arguments
    with ExitStack() as files:
        picture = None if request.picture is None else files.enter_context(replacing(request.picture))
        derived = files.enter_context(face.deriving(request.out, flatten=given.flatten))
        with named(given.neutral):
            report = AuthorNeutral()(derived, found.points, recipe=recipe)
        if picture is not None:
            neutral = found.points if request.expression.any() else None
            draw_fit(picture, template, found.points + request.expression, scan, found.place, neutral)
    return report.warnings


def _tell(request: _Request, report: RefineReport, warnings: tuple[str, ...]) -> int:
    """Print what was done; the exit code."""
    from facepipe.processors.database import QualityLimits, misses

    given, missed = request.arguments, misses(report.quality, QualityLimits())
    told = [*warnings, *missed]
    warn(told)
    result = {"path": str(request.out), "regions": given.region, **json.loads(report.to_json())}
    result |= {"warnings": told, "missed": list(missed)}
    lines = [_text(request.out, given.region, report)]
    if request.picture is not None:
        result["picture"] = str(request.picture)
        lines.append(str(request.picture))
    emit(result, "\n".join(lines), as_json=given.json)
    return 1 if missed else 0


def _text(out: Path, regions: list[str], report: RefineReport) -> str:
    off = f", {len(report.outliers)} of them lie off" if report.outliers else ""
    rows = [
        ("refined", f"{', '.join(regions) or 'all'}: {report.points} points"),
        ("distance before", f"mean {report.before_mean_mm:.3f} mm, 95 % below {report.before_p95_mm:.3f} mm"),
        ("distance now", f"mean {report.surface_mean_mm:.3f} mm, 95 % below {report.surface_p95_mm:.3f} mm"),
        ("shown by the scan", f"{100 * report.coverage:.1f} % of its outside"),
        ("moved", f"mean {report.moved_mean_mm:.2f} mm, at most {report.moved_max_mm:.2f} mm"),
        ("flipped triangles", f"{report.flipped_triangles}"),
        ("steps", f"{report.steps}"),
    ]
    if report.landmark_mean_mm is not None:
        rows.insert(4, ("landmarks", f"{report.landmark_mean_mm:.2f} mm off (mean){off}"))
    return "\n".join([str(out), table(rows)])
