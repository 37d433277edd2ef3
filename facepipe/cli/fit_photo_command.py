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
from typing import TYPE_CHECKING, NamedTuple

from facepipe.atomic import replacing_folder
from facepipe.cli.fit_photo_request import MODELS, Request, request_of
from facepipe.cli.fit_photo_text import as_text, off_landmarks
from facepipe.cli.parser import add_options
from facepipe.cli.show import emit, progress, warn
from facepipe.errors import FacepipeError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from facepipe.learn.features.description import Kind
    from facepipe.learn.features.extractor import Extractor
    from facepipe.learn.photo.landmark_fit import State
    from facepipe.learn.photo.result import PhotoFit
    from facepipe.parts import FaceParts, Recipe
    from facepipe.processors.photo_fit import Landmarks68, Photo, PhotoFitReport
    from facepipe.stage import Face

INTERMIXED = True  # photos and their landmarks may be given in turn


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments."""
    from facepipe.photo_options import PhotoFitOptions

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

    begin, request = time.perf_counter(), request_of(arguments)
    warn(request.warnings)
    recipe = _recipe(request)
    face = facepipe.open(request.face)
    inputs = _read(request)
    warn(inputs.warnings)
    parts = face.parts()
    fit = _fit(parts, inputs, request)
    report = _author(face, parts, fit, inputs, request, recipe)
    warn(report.warnings[len(request.warnings) + len(inputs.warnings) :])
    seconds = time.perf_counter() - begin
    result = {"path": str(request.out), "seconds": seconds, **json.loads(report.to_json())}
    text = as_text(request.out, report, face.sliders, seconds)
    if request.report is not None:
        result["report"] = str(request.report)
        text += f"\n{request.report}"
    emit(result, text, as_json=arguments.json)
    return 1 if report.missed or off_landmarks(report, request.threshold) else 0


class _Inputs(NamedTuple):
    """What is fitted to."""

    photos: list[Photo]
    landmarks: list[Landmarks68]
    extractors: Mapping[Kind, Extractor]  # by kind of features
    warnings: tuple[str, ...]


def _recipe(request: Request) -> Recipe:
    from facepipe.processors.photo_fit import photo_recipe

    return photo_recipe(
        request.face,
        request.photos,
        request.out,
        landmarks=request.landmarks,
        files=request.files(),
        options=request.settings(),
    )


def _read(request: Request) -> _Inputs:
    """Photos, where their landmarks are, and the networks that compare them."""
    from facepipe.processors.photo_fit import read_photo

    photos = [read_photo(path) for path in request.photos]
    landmarks = [_landmarks(photo, request, number) for number, photo in enumerate(photos)]
    warnings = [f"{photo.path}: {line}" for photo in photos for line in photo.warnings]
    warnings += [
        f"{photo.path}: {line}" for photo, each in zip(photos, landmarks, strict=True) for line in each.warnings
    ]
    return _Inputs(photos, landmarks, _extractors(request), tuple(warnings))


def _landmarks(photo: Photo, request: Request, number: int) -> Landmarks68:
    from facepipe.processors.photo_fit import mediapipe_landmarks, own_landmarks, read_landmarks

    file, index = request.landmarks[number], request.faces[number]
    if file is not None:
        return read_landmarks(file, photo, index=index)
    if request.landmarker is not None:
        return mediapipe_landmarks(photo, request.landmarker, index=index)
    return own_landmarks(photo, index=index)


def _extractors(request: Request) -> Mapping[Kind, Extractor]:
    """The networks of the line, and facepipe's own for the other terms that are on."""
    from facepipe.learn.features.extractor import load_extractor

    given: dict[Kind, Extractor] = {
        MODELS[name]: load_extractor(path, MODELS[name]) for name, path in request.models.items()
    }
    missing = [kind for kind in MODELS.values() if kind not in given and getattr(request.options, kind)]
    if not missing or not request.options.iterations:
        return given
    from facepipe.learn.networks import own_extractors

    return {**own_extractors(missing), **given}


def _fit(parts: FaceParts, inputs: _Inputs, request: Request) -> PhotoFit:
    from facepipe.learn.photo.fit import fit_photos

    start = _start(parts, inputs, request)
    try:
        with progress("fit", request.options.iterations) as bar:
            return fit_photos(
                parts,
                [photo.pixels for photo in inputs.photos],
                [each.points for each in inputs.landmarks],
                request.options,
                expressions=request.expressions,
                extractors=inputs.extractors,
                start=start,
                done=bar.update,
            )
    except FacepipeError as error:
        raise error.under(request.face) from None


def _start(parts: FaceParts, inputs: _Inputs, request: Request) -> State | None:
    """Where a network guesses that the fit should start; None: at the defaults."""
    if request.start is None:
        return None
    from facepipe.learn.photo.amortised.guess import load_start
    from facepipe.learn.photo.fit import pose_space
    from facepipe.learn.photo.subject import Subject

    try:
        subject = Subject.of(parts, request.expressions)
        spaces = [pose_space(subject, photo.pixels.shape[1], photo.pixels.shape[0]) for photo in inputs.photos]
    except FacepipeError as error:
        raise error.under(request.face) from None
    guess = load_start(request.start, subject)
    return guess.together([photo.pixels for photo in inputs.photos], [each.points for each in inputs.landmarks], spaces)


def _author(
    face: Face, parts: FaceParts, fit: PhotoFit, inputs: _Inputs, request: Request, recipe: Recipe
) -> PhotoFitReport:
    """Save: the stage and its report, or none of them."""
    from facepipe.processors.photo_fit import AuthorPhotoFit

    with ExitStack() as files:
        folder = None if request.report is None else files.enter_context(replacing_folder(request.report))
        derived = files.enter_context(face.deriving(request.out, flatten=request.flatten))
        try:
            report = AuthorPhotoFit()(derived, fit, inputs.photos, recipe=recipe)
        except FacepipeError as error:  # the layer being made has no file yet: name its source
            raise error.under(request.face) if error.where.startswith(("<", "/")) else error from None
        warnings = (*report.warnings, *off_landmarks(report, request.threshold))
        report = replace(report, warnings=(*request.warnings, *inputs.warnings, *warnings))
        if folder is not None:
            _write_report(folder, parts, fit, inputs, report)
    return report


def _write_report(folder: Path, parts: FaceParts, fit: PhotoFit, inputs: _Inputs, report: PhotoFitReport) -> None:
    from facepipe.cli.fit_photo_folder import write_folder
    from facepipe.cli.fit_photo_sheet import report_sheet

    with progress("report", 1) as bar:
        write_folder(folder, report_sheet(parts, fit, inputs.photos), inputs.photos, inputs.landmarks, report)
        bar.update()
