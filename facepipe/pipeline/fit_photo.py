"""Photo fits: made by `facepipe fit-photo`, and made again from their recipes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from facepipe.core.errors import FacepipeError
from facepipe.kinds import Watch
from facepipe.parts import FaceParts, Recipe
from facepipe.photo_options import MODELS
from facepipe.pipeline.photo_job import PhotoJob, recipe_job
from facepipe.pipeline.verbs import Cooked, under_source
from facepipe.processors.photo_fit import AuthorPhotoFit, Landmarks68, Photo, PhotoFitReport, read_photo
from facepipe.processors.photo_fit.report import off_landmarks
from facepipe.stage import Face, open_face

if TYPE_CHECKING:
    from facepipe.learn.features.description import Kind
    from facepipe.learn.features.extractor import Extractor
    from facepipe.learn.photo.landmark_fit import State
    from facepipe.learn.photo.result import PhotoFit


class PhotoInputs(NamedTuple):
    """What is fitted to."""

    photos: list[Photo]
    landmarks: list[Landmarks68]
    extractors: Mapping[Kind, Extractor]  # by kind of features
    recipe: Recipe  # with the digests that files had before they were read
    warnings: tuple[str, ...]


class Fitted(NamedTuple):
    """A fit that is authored and not yet saved."""

    parts: FaceParts  # of the face that was fitted
    fit: PhotoFit
    inputs: PhotoInputs
    report: PhotoFitReport


def cook(path: Path, watch: Watch) -> Cooked:
    """Fit again in the place of the result at `path`.

    :raises FacepipeError: a recipe or sources that can't be read, or that can't be fitted
    """
    job = recipe_job(path)
    inputs = read_inputs(job)
    report = make(job, open_face(job.face), inputs, watch)
    return Cooked(report=report, missed=missed(report, job))


def missed(report: PhotoFitReport, job: PhotoJob) -> bool:
    """Whether the fit ended before its time, or landmarks are off by more than the threshold."""
    return report.missed or bool(off_landmarks(report, job.threshold))


def read_inputs(job: PhotoJob) -> PhotoInputs:
    """Photos, where their landmarks are, and the networks that compare them.

    :raises FacepipeError: what can't be read, or landmarks that are not found
    """
    recipe = job.recipe()
    photos = [read_photo(path) for path in job.photos]
    landmarks = [_landmarks(photo, job, number) for number, photo in enumerate(photos)]
    warnings = [f"{photo.path}: {line}" for photo in photos for line in photo.warnings]
    warnings += [
        f"{photo.path}: {line}" for photo, each in zip(photos, landmarks, strict=True) for line in each.warnings
    ]
    return PhotoInputs(photos, landmarks, _extractors(job), recipe, tuple(warnings))


def _landmarks(photo: Photo, job: PhotoJob, number: int) -> Landmarks68:
    from facepipe.processors.photo_fit import mediapipe_landmarks, own_landmarks, read_landmarks

    file, index = job.landmarks[number], job.faces[number]
    if file is not None:
        return read_landmarks(file, photo, index=index)
    if job.landmarker is not None:
        return mediapipe_landmarks(photo, job.landmarker, index=index)
    return own_landmarks(photo, index=index)


def _extractors(job: PhotoJob) -> Mapping[Kind, Extractor]:
    """The networks of the job, and facepipe's own for the other terms that are on."""
    from facepipe.learn.features.extractor import load_extractor

    given: dict[Kind, Extractor] = {
        MODELS[name]: load_extractor(path, MODELS[name]) for name, path in job.models.items()
    }
    missing = [kind for kind in MODELS.values() if kind not in given and getattr(job.options, kind)]
    if not missing or not job.options.iterations:
        return given
    from facepipe.learn.networks import own_extractors

    return {**own_extractors(missing), **given}


def make(
    job: PhotoJob,
    face: Face,
    inputs: PhotoInputs,
    watch: Watch,
    seen: Callable[[Fitted], object] = lambda fitted: None,
) -> PhotoFitReport:
    """Fit, author, save.

    :param face: the opened face
    :param seen: called with the result before it is saved
    :raises FacepipeError: what can't be fitted or written
    """
    parts = face.parts()
    fit = _fit(parts, inputs, job, watch)
    with face.deriving(job.out, flatten=job.flatten) as derived:
        with under_source(job.face):
            report = AuthorPhotoFit()(derived, fit, inputs.photos, recipe=inputs.recipe)
        warnings = (*inputs.warnings, *report.warnings, *off_landmarks(report, job.threshold))
        report = replace(report, warnings=warnings)
        seen(Fitted(parts, fit, inputs, report))
    return report


def _fit(parts: FaceParts, inputs: PhotoInputs, job: PhotoJob, watch: Watch) -> PhotoFit:
    from facepipe.learn.photo.fit import fit_photos

    start = _start(parts, inputs, job)
    try:
        with watch("fit", job.options.iterations) as bar:
            return fit_photos(
                parts,
                [photo.pixels for photo in inputs.photos],
                [each.points for each in inputs.landmarks],
                job.options,
                expressions=job.expressions,
                extractors=inputs.extractors,
                start=start,
                done=bar.update,
            )
    except FacepipeError as error:
        raise error.under(job.face) from None


def _start(parts: FaceParts, inputs: PhotoInputs, job: PhotoJob) -> State | None:
    """Where a network guesses that the fit should start; None: at the defaults."""
    if job.start is None:
        return None
    from facepipe.learn.photo.amortised.guess import load_start
    from facepipe.learn.photo.fit import pose_space
    from facepipe.learn.photo.subject import Subject

    try:
        subject = Subject.of(parts, job.expressions)
        spaces = [pose_space(subject, photo.pixels.shape[1], photo.pixels.shape[0]) for photo in inputs.photos]
    except FacepipeError as error:
        raise error.under(job.face) from None
    guess = load_start(job.start, subject)
    return guess.together([photo.pixels for photo in inputs.photos], [each.points for each in inputs.landmarks], spaces)
