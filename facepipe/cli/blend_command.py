"""Blend faces of one topology: the eyes of one, the mouth of another, with all shapes and the rig.

OUT is an override layer over the first SOURCE and needs that file; hand on what --flatten writes.

Weights are given per region, one per SOURCE, and normalised to sum 1. Regions are those of the first SOURCE (`facepipe
regions` lists them); regions without weights take --default, or all sources alike. A file of weights holds what the
flags say, which win: {"regions": {"eyes": [0.8, 0.2]}, "default": [0.5, 0.5], "gains": [1, 1], "locked": {"mouth": 2}},
or flat {"eyes": [0.8, 0.2], "default": [0.5, 0.5]}.

The recipe stays on the result. --edit blends again from it with what the line changes: weights, locks, sources, and the
options below. Without -o that is in place (with --force), and anything else authored in that file is lost. --match
finds the weights whose blend comes nearest to a target sculpt of the same topology.

examples:
  facepipe blend a.usda b.usda -o c.usda --set eyes=0.8,0.2 --set mouth=0.3,0.7 --default 0.5,0.5
  facepipe blend --edit c.usda --set eyes=0.6,0.4 --lock mouth=2 --force
  facepipe blend --edit c.usda --replace 2=other.usda -o d.usda
  facepipe blend --match c.usda a.usda b.usda -o e.usda
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.cli.blend_request import Request, request_of
from facepipe.cli.blend_text import as_text, match_text
from facepipe.cli.parser import add_options
from facepipe.cli.show import emit, progress, warn

if TYPE_CHECKING:
    from PIL.Image import Image

    from facepipe.processors.blend import BlendReport, BlendSession, MatchReport, Weights
    from facepipe.stage import Face


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments."""
    from facepipe.processors.blend import BlendOptions

    add = parser.add_argument
    text = "face stages of one topology; the first gives regions, sliders, UVs, materials"
    add("sources", nargs="*", type=Path, metavar="SOURCE", help=text)
    add("-o", "--output", type=Path, metavar="OUT", help="override layer to write: .usda .usdc .usd .usdz")
    add("--force", action="store_true", help="overwrite OUT, with --edit the result, and the picture")
    add("--weights", type=Path, metavar="JSON", help="weights from a file")
    add("--set", action="append", default=[], metavar="REGION=W,W,...", help="weights of a region; a flag for each")
    add("--default", metavar="W,W,...", help="weights of all other regions, and of points in none")
    add("--gains", metavar="G,G,...", help="factors on each source's weights, everywhere")
    add("--lock", action="append", default=[], metavar="REGION=N", help="take a region whole from source N, from 1")
    add("--unlock", action="append", default=[], metavar="REGION", help="weights of the region count again")
    add(
        "--edit",
        type=Path,
        metavar="RESULT",
        help="blend again from the recipe of a result, with what else is given changed",
    )
    add("--replace", action="append", default=[], metavar="N=FACE", help="with --edit: another face for source N")
    add("--match", type=Path, metavar="TARGET", help="find the weights that come nearest to this face")
    add("--heatmap", type=Path, metavar="PNG", help="draw the result, coloured by its seam residual")
    add("--flatten", action="store_true", help="write a standalone file")
    add("--json", action="store_true", help="print the report as JSON")
    add_options(parser, BlendOptions, "how to blend (kept in the recipe; with --edit they change it)", sparse=True)


def run(arguments: argparse.Namespace) -> int:
    """Open, blend, report."""
    import facepipe
    from facepipe.processors.blend import BlendSession

    request = request_of(arguments)
    warn(request.warnings)
    faces = [facepipe.open(path) for path in request.sources]
    if request.target is None:
        _check(request.weights, faces)
    target = None if request.target is None else facepipe.open(request.target)
    start = time.perf_counter()
    session = BlendSession(faces, request.options, live=False)
    found = None if target is None else _match(session, target, request)
    report = _blend(session, request, request.weights if found is None else found.weights)
    report = replace(report, seconds=time.perf_counter() - start)  # with reading and factoring, which a session does
    warnings = tuple(dict.fromkeys((*request.warnings, *(found.warnings if found else ()), *report.warnings)))
    warn(line for line in warnings if line not in request.warnings)
    text = [as_text(request.out, report)]
    result = {"path": str(request.out), **json.loads(report.to_json())}
    result["warnings"] = list(warnings)
    if found is not None:
        text.insert(0, match_text(found, report.sources))
        result["match"] = json.loads(found.to_json())
    if request.picture is not None:
        text.append(str(request.picture))
        result["picture"] = str(request.picture)
    emit(result, "\n".join(text), as_json=arguments.json)
    return 0


def _check(weights: Weights, faces: list[Face]) -> None:
    """What the blend checks too, before the work that comes first there."""
    from facepipe.parts import all_regions

    weights.shares(list(all_regions(faces[0].meshes)), len(faces))


def _match(session: BlendSession, target: Face, request: Request) -> MatchReport:
    from facepipe.processors.blend import match

    return match(session, target, request.weights.locked)


def _blend(session: BlendSession, request: Request, weights: Weights) -> BlendReport:
    """Blend, author, save; the picture is drawn before anything is saved."""
    from facepipe.core.atomic import together
    from facepipe.pictures import save_png
    from facepipe.pipeline.blend import make

    images: list[Image] = []

    def seen(face: Face) -> None:
        if request.picture is not None:
            images.append(_draw(face))

    with together(request.out):
        report = make(session, request.sources, weights, request.out, progress, flatten=request.flatten, seen=seen)
        if images and request.picture is not None:
            save_png(images[0], request.picture)
    return report


def _draw(face: Face) -> Image:
    from facepipe.core.tokens import SEAM_RESIDUAL
    from facepipe.pictures import HeatMap, PictureOptions, picture

    heatmap = HeatMap(values=face.primvar(SEAM_RESIDUAL), label="seam residual")
    return picture(face.parts(), None, PictureOptions(heatmap=heatmap))
