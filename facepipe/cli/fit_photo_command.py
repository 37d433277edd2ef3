"""Fit a face to photos of a person: slider values, and the expression, camera and light of each photo.

FACE has sliders and the 68 landmarks `multipie68` (`facepipe sliders`, `facepipe landmarks`). Several photos show the
same person and share the sliders. First landmarks are fitted, then the picture, by gradient descent on the joint loss;
that needs `pip install 'facepipe[train]'`.

The photos' landmarks come from JSON files (--landmarks, one a photo, in order; 68 places or MediaPipe's 478), from
MediaPipe (--landmarker) or, with neither, from facepipe's own network. Where a photo shows several faces, --face says
which: from 0, the largest first; of a JSON file in its order.

Features that photo and render are compared by come from facepipe's own networks, trained on synthetic heads, or from
models of yours: ONNX, or torch.export programs from people you trust.

OUT is an override layer over FACE and needs that file; hand on what --flatten writes. It holds the slider values, which
can be set further (`facepipe sliders`), the neutral, which its skeleton plays, and for each photo a camera and the pose
with the photo's expression. --report makes a folder: sheet.png, report.json, and for each photo the render from its
camera, the overlay of mesh and landmarks, and the landmarks as JSON for --landmarks, to be mended by hand. Exit code 1:
done, but the landmarks are off by more than the threshold, or the loss was not finite and the best until then is kept.

The recipe stays on the result. --edit fits again from it with what the line changes: FACE alone is another face, PHOTO
... FACE also other photos. Without -o that is in place (with --force), and anything else authored in that file is lost.

examples:
  facepipe fit-photo portrait.jpg head.usda -o person.usda --report person
  facepipe fit-photo front.jpg side.jpg head.usda --landmarks front.json --landmarks side.json -o person.usda
  facepipe fit-photo --edit person.usda --iterations 400 --sparsity 0.3 --force
"""

from __future__ import annotations

import argparse
import json
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.cli.fit_photo_request import Request, request_of
from facepipe.cli.fit_photo_text import as_text
from facepipe.cli.parser import Parser, add_options
from facepipe.cli.show import emit, progress, warn
from facepipe.core.atomic import replacing_folder, together

if TYPE_CHECKING:
    from facepipe.pipeline.fit_photo import Fitted, PhotoInputs
    from facepipe.processors.photo_fit import PhotoFitReport
    from facepipe.stage import Face


def configure(parser: Parser, words: list[str]) -> None:
    """Add the arguments."""
    parser.intermixed = True  # photos and their landmarks may be given in turn
    from facepipe.photo_options import MODELS, PhotoFitOptions

    add, absent = parser.add_argument, argparse.SUPPRESS
    add("files", nargs="*", type=Path, metavar="PHOTO ... FACE", help="photos of one person, then the face stage")
    add("-o", "--output", type=Path, metavar="OUT", help="override layer to write: .usda .usdc .usd .usdz")
    add("--force", action="store_true", help="overwrite OUT, with --edit FITTED, and the report")
    add("--edit", type=Path, metavar="FITTED", help="fit again from the recipe of a result, with what else is given")
    add("--report", type=Path, metavar="DIR", help="folder to make: sheet, report, pictures, landmarks")
    add("--flatten", action="store_true", help="write a standalone file")
    add("--json", action="store_true", help="print the report as JSON")
    group = parser.add_argument_group("what to fit (kept in the recipe; with --edit they change it)")
    add, text = group.add_argument, "landmarks of a photo; a flag for each, in the order of the photos"
    add("--landmarks", dest="landmark_files", action="append", type=Path, default=[], metavar="JSON", help=text)
    add("--landmarker", type=Path, metavar="TASK", help="find landmarks by MediaPipe: its model face_landmarker.task")
    text = "which of several faces, from 0; once, or a flag for each photo"
    add("--face", dest="faces", action="append", type=int, default=absent, metavar="INDEX", help=text)
    text = "shape that is an expression; may be given again (default those with ARKit's names)"
    add("--expression", dest="expressions", action="append", default=absent, metavar="NAME", help=text)
    for name, kind in MODELS.items():
        text = f"network for {kind}, .onnx or .pt2 (default facepipe's own)"
        add(f"--{name.replace('_', '-')}", type=Path, metavar="FILE", help=text)
    text = "network of `facepipe train-photo` for FACE, which guesses where to start"
    add("--start", type=Path, metavar="FILE", help=text)
    text = "mean error, percent of the distance of the outer eye corners, above which the exit code is 1 (default 8)"
    add("--landmark-threshold", type=float, default=absent, metavar="PERCENT", help=text)
    text = "weight of the landmarks (default 1.0)"
    add("--landmark-weight", dest="landmarks", type=float, default=absent, metavar="LANDMARKS", help=text)
    add_options(group, PhotoFitOptions, sparse=True)


def run(arguments: argparse.Namespace) -> int:
    """Read, fit, author, report."""
    import facepipe
    from facepipe.pipeline.fit_photo import missed, read_inputs

    begin, request = time.perf_counter(), request_of(arguments)
    warn(request.warnings)
    face = facepipe.open(request.job.face)
    inputs = read_inputs(request.job)
    warn(inputs.warnings)
    report = _make(face, inputs, request)
    warn(report.warnings[len(request.warnings) + len(inputs.warnings) :])
    seconds, out = time.perf_counter() - begin, request.job.out
    result = {"path": str(out), "seconds": seconds, **json.loads(report.to_json())}
    text = as_text(out, report, face.sliders, seconds)
    if request.report is not None:
        result["report"] = str(request.report)
        text += f"\n{request.report}"
    emit(result, text, as_json=arguments.json)
    return 1 if missed(report, request.job) else 0


def _make(face: Face, inputs: PhotoInputs, request: Request) -> PhotoFitReport:
    """Fit and save: the stage and its report, or none of them."""
    from facepipe.pipeline.fit_photo import make

    def whole(report: PhotoFitReport) -> PhotoFitReport:
        return replace(report, warnings=(*request.warnings, *report.warnings))

    with together(request.job.out), ExitStack() as files:
        folder = None if request.report is None else files.enter_context(replacing_folder(request.report))

        def seen(fitted: Fitted) -> None:
            if folder is not None:
                _write_report(folder, fitted, whole(fitted.report))

        return whole(make(request.job, face, inputs, progress, seen))


def _write_report(folder: Path, fitted: Fitted, report: PhotoFitReport) -> None:
    from facepipe.cli.fit_photo_folder import write_folder
    from facepipe.cli.fit_photo_sheet import report_sheet

    parts, fit, inputs, _ = fitted
    with progress("report", 1) as bar:
        write_folder(folder, report_sheet(parts, fit, inputs.photos), inputs.photos, inputs.landmarks, report)
        bar.update()
