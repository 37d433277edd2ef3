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
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.cli.parser import add_options, add_output, options_from, output_of, pairs, picture_of
from facepipe.cli.show import emit, progress, warn
from facepipe.core.atomic import replacing, together
from facepipe.core.texts import table
from facepipe.processors.rebuild.scan_input import landmark_file

if TYPE_CHECKING:
    from facepipe.pipeline.rebuild_stage import Made
    from facepipe.pipeline.refine_neutral import Refined, RefineJob
    from facepipe.processors.rebuild import RefineReport


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments."""
    from facepipe.processors.rebuild import RefineNeutralOptions

    add = parser.add_argument
    add("neutral", type=Path, metavar="NEUTRAL", help="face stage with the person's neutral")
    add("scan", type=Path, metavar="SCAN", help="its scan: .ply .obj .stl .off .glb .gltf or USD")
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
    from facepipe.pipeline.refine_neutral import RefineJob
    from facepipe.processors.rebuild import RefineNeutralOptions

    file = landmark_file(arguments.scan, arguments.landmarks)
    inputs = [arguments.neutral, arguments.scan, *([file] if file else [])]
    out = output_of(arguments, inputs)
    picture = None if arguments.picture is None else picture_of(arguments.picture, arguments, inputs, out)
    job = RefineJob(
        neutral=arguments.neutral,
        scan=arguments.scan,
        landmarks=file,
        out=out,
        regions=tuple(arguments.region),
        weights=pairs(arguments.weights or [], "--weights"),
        options=options_from(arguments, RefineNeutralOptions),
        flatten=arguments.flatten,
    )
    made = _make(job, picture)
    return _tell(made, job, picture, as_json=arguments.json)


def _make(job: RefineJob, picture: Path | None) -> Made[RefineReport]:
    """Write the stage and the picture, or neither."""
    from facepipe.pipeline.refine_neutral import make
    from facepipe.processors.rebuild.scan_picture import draw_fit

    with together(job.out), ExitStack() as files:
        image = None if picture is None else files.enter_context(replacing(picture))

        def seen(refined: Refined) -> None:
            if image is not None:
                found, expression = refined.found, refined.expression
                neutral = found.points if expression.any() else None
                draw_fit(image, refined.template, found.points + expression, refined.scan, found.place, neutral)

        return make(job, progress, seen)


def _tell(made: Made[RefineReport], job: RefineJob, picture: Path | None, *, as_json: bool) -> int:
    """Print what was done; the exit code."""
    report, missed = made
    warn(report.warnings)
    result = {"path": str(job.out), "regions": list(job.regions), **json.loads(report.to_json())}
    result["missed"] = list(missed)
    lines = [_text(job.out, list(job.regions), report)]
    if picture is not None:
        result["picture"] = str(picture)
        lines.append(str(picture))
    emit(result, "\n".join(lines), as_json=as_json)
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
