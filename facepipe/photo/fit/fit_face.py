"""A face fitted to photos: what is read for that, and the fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import FacepipeError
from facepipe.kinds import Watch
from facepipe.networks.masks import face_mask
from facepipe.parts import FaceParts
from facepipe.photo.fit.landmark_file import read_landmarks
from facepipe.photo.fit.person_model import REACH
from facepipe.photo.fit.photo_file import Photo, read_photo
from facepipe.photo.fit.photo_landmarks import Landmarks68, mediapipe_landmarks, own_landmarks
from facepipe.photo.options import MODELS

if TYPE_CHECKING:
    from facepipe.networks.onnx_file import Kind
    from facepipe.photo.descent.landmark_fit import State
    from facepipe.photo.descent.subject import PhotoFit
    from facepipe.photo.features.extractor import Extractor
    from facepipe.photo.fit.fit_photo_action import FitPhoto
    from facepipe.photo.fit.person_model import IdentityReport, PersonModel
    from facepipe.photo.pictures.photo_report import PhotoSheet
    from facepipe.stage import Face


class PhotoInputs(NamedTuple):
    """What is fitted to."""

    photos: list[Photo]
    landmarks: list[Landmarks68]
    extractors: Mapping[Kind, Extractor]  # by kind of features
    warnings: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Fitted:
    """A fit, for what is written of it."""

    parts: FaceParts  # of the face that was fitted
    fit: PhotoFit
    inputs: PhotoInputs

    @cached_property
    def sheet(self) -> PhotoSheet:
        """What the report page shows of it."""
        from facepipe.photo.fit.report import report_sheet

        return report_sheet(self.parts, self.fit, self.inputs.photos)


def read_inputs(action: FitPhoto) -> PhotoInputs:
    """Photos, where their landmarks are, and the networks that compare them.

    :raises FacepipeError: what can't be read, or landmarks that are not found
    """
    photos = [read_photo(path) for path in action.photos]
    landmarks = [_landmarks(photo, action, number) for number, photo in enumerate(photos)]
    warnings = [f"{photo.path}: {line}" for photo in photos for line in photo.warnings]
    warnings += [
        f"{photo.path}: {line}" for photo, each in zip(photos, landmarks, strict=True) for line in each.warnings
    ]
    return PhotoInputs(photos, landmarks, _extractors(action), tuple(warnings))


def _landmarks(photo: Photo, action: FitPhoto, number: int) -> Landmarks68:
    faces = action.faces if len(action.faces) != 1 else action.faces * len(action.photos)
    index = faces[number] if faces else None
    if action.landmarks:
        return read_landmarks(action.landmarks[number], photo, index=index)
    if action.landmarker is not None:
        return mediapipe_landmarks(photo, action.landmarker, index=index)
    return own_landmarks(photo, index=index)


def _extractors(action: FitPhoto) -> Mapping[Kind, Extractor]:
    """The networks that were given, and facepipe's own for the other terms that are on."""
    from facepipe.photo.features.extractor import load_extractor

    paths = {kind: getattr(action, name) for name, kind in MODELS.items()}
    given: dict[Kind, Extractor] = {
        kind: load_extractor(path, kind) for kind, path in paths.items() if path is not None
    }
    missing = [kind for kind in MODELS.values() if kind not in given and getattr(action, kind)]
    if not missing or not action.iterations:
        return given
    from facepipe.photo.features.extractor import own_extractors

    return {**own_extractors(missing), **given}


def fit_face(
    action: FitPhoto, parts: FaceParts, inputs: PhotoInputs, watch: Watch, slider_sigma: float | None = None
) -> PhotoFit:
    """Fit the face of the action.

    :param slider_sigma: as for `fit_photos`
    :raises FacepipeError: what can't be fitted
    """
    from facepipe.photo.descent.fit import fit_photos

    start, known = _start(action, parts, inputs), _known(parts, inputs.landmarks)
    try:
        with watch("fit", action.iterations) as bar:
            fit = fit_photos(
                parts,
                [photo.pixels for photo in inputs.photos],
                [points for points, _ in known],
                action.options,
                confidences=[confidence for _, confidence in known],
                expressions=action.expressions,
                extractors=inputs.extractors,
                start=start,
                slider_sigma=slider_sigma,
                mask=_face,
                done=lambda _: bar.update(),
            )
        pairs = zip(fit.views, inputs.landmarks, strict=True)
        return replace(fit, views=tuple(replace(view, pupils=marks.pupils) for view, marks in pairs))
    except FacepipeError as error:
        raise error.under(action.face) from None


def _face(photo: FloatArray, landmarks: FloatArray) -> FloatArray:
    """(h, w) share of a photo's pixels that is face."""
    return face_mask(np.asarray(photo, np.float32), landmarks).face


def _known(parts: FaceParts, landmarks: Sequence[Landmarks68]) -> list[tuple[FloatArray, FloatArray]]:
    """Landmarks and confidences of each photo: with the dense ones that were found where the face has them."""
    from facepipe.photo.descent.landmark_rig import dense_points

    count = len(dense_points(parts))
    more = [slice(0, count if len(each.dense) == count else 0) for each in landmarks]
    return [
        (np.vstack([each.points, each.dense[some]]), np.append(each.confidence, each.dense_confidence[some]))
        for each, some in zip(landmarks, more, strict=True)
    ]


def _start(action: FitPhoto, parts: FaceParts, inputs: PhotoInputs) -> State | None:
    """Where a network guesses that the fit should start; None: at the defaults."""
    if action.start is None:
        return None
    from facepipe.photo.amortised.guess import load_start
    from facepipe.photo.descent.fit import pose_space
    from facepipe.photo.descent.subject import Subject

    try:
        subject = Subject.of(parts, action.expressions)
        spaces = [pose_space(subject, photo.pixels.shape[1], photo.pixels.shape[0]) for photo in inputs.photos]
    except FacepipeError as error:
        raise error.under(action.face) from None
    guess = load_start(action.start, subject)
    return guess.together([photo.pixels for photo in inputs.photos], [each.points for each in inputs.landmarks], spaces)


def fit_person(
    action: FitPhoto, model: PersonModel, face: Face, inputs: PhotoInputs, watch: Watch
) -> tuple[PhotoFit, IdentityReport]:
    """Fit the modes of identity, put the person into the neutral of `face`, and give the fit in terms of its sliders.

    :raises FacepipeError: what can't be fitted
    """
    from facepipe.photo.descent.subject import Subject
    from facepipe.rig.conventions import ARKIT_SHAPES

    sliders = Subject.of(model.parts, action.expressions).free_sliders
    free = ARKIT_SHAPES if action.expressions is None else frozenset(action.expressions)
    fit = fit_face(action, model.fit_parts(free), inputs, watch, 1 / (2 * REACH))
    weights = np.array([fit.sliders[name] for name in model.names])
    values, report = model.author(face, weights, sliders)
    return replace(fit, sliders=values), report
