"""What a photo fit can be given."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.geometry.landmarks import eye_distance
from facepipe.networks.description import Kind
from facepipe.photo.descent.joint_loss import FEATURES
from facepipe.photo.descent.landmark_fit import State
from facepipe.photo.descent.landmark_rig import COUNT
from facepipe.photo.descent.pose import NUMBERS, PoseSpace
from facepipe.photo.descent.subject import Subject
from facepipe.photo.features.extractor import Extractor

_PHOTO = "expected an array of floating-point sRGB 0 to 1"
_LANDMARKS = "expected a finite array ({}, 2) of pixels"


def check_photos(photos: Sequence[FloatArray], landmarks: Sequence[FloatArray], dense: int = 0) -> list[FloatArray]:
    """The landmarks in float64.

    :param dense: how many the face has beside the 68
    :raises InputError: no photo, or arrays that are no photos with a face's landmarks
    """
    if len(photos) == 0 or len(photos) != len(landmarks):
        raise InputError("photos", f"{len(photos)} with {len(landmarks)} sets of landmarks, expected one for each")
    for number, (photo, marks) in enumerate(zip(photos, landmarks, strict=True)):
        _check_photo(f"photo {number}", photo)
        _check_landmarks(f"landmarks {number}", marks, dense)
    return [np.asarray(marks, dtype=np.float64) for marks in landmarks]


def _check_photo(where: str, photo: FloatArray) -> None:
    _check_array(where, photo, "f", _PHOTO)
    if photo.ndim != 3 or photo.shape[2] != 3 or not photo.size:
        raise InputError(where, f"shape {photo.shape}, expected finite (height, width, 3)")
    if not np.isfinite(photo).all():
        raise InputError(where, "NaN or infinity, expected finite (height, width, 3)")
    if photo.max() > 1 or photo.min() < 0:
        raise InputError(where, f"values {photo.min():g} to {photo.max():g}, expected 0 to 1")


def _check_landmarks(where: str, marks: FloatArray, dense: int) -> None:
    expected = _LANDMARKS.format(f"{COUNT} or {COUNT + dense}" if dense else COUNT)
    _check_array(where, marks, "fiu", expected)
    if marks.shape not in ((COUNT, 2), (COUNT + dense, 2)):
        raise InputError(where, f"shape {marks.shape}, {expected}")
    if not np.isfinite(marks).all():
        raise InputError(where, f"NaN or infinity, {expected}")
    if not eye_distance(marks) > 0:
        raise InputError(where, "outer corners of the eyes at one place, expected those of a face")


def check_confidences(confidences: Sequence[FloatArray], counts: Sequence[int]) -> list[FloatArray]:
    """The confidences of so many landmarks of each photo in float64.

    :raises InputError: another number of them, or arrays that are no numbers 0 to 1
    """
    if len(confidences) != len(counts):
        raise InputError("confidences", f"{len(confidences)} of {len(counts)} photos, expected one for each")
    checked = [
        _numbers(f"confidences {number}", each, (count,), "one for each landmark")
        for number, (each, count) in enumerate(zip(confidences, counts, strict=True))
    ]
    for number, each in enumerate(checked):
        if not 0 <= each.min() <= each.max() <= 1:
            raise InputError(f"confidences {number}", f"values {each.min():g} to {each.max():g}, expected 0 to 1")
    return checked


def check_start(start: State, subject: Subject, spaces: Sequence[PoseSpace]) -> State:
    """The same in float64.

    :raises InputError: a state of another face, of another number of photos, or of what can't be
    """
    views = len(spaces)
    checked = State(
        shares=_numbers("start -> shares", start.shares, (len(subject.sliders),), "one for each free slider"),
        expressions=_numbers(
            "start -> expressions", start.expressions, (views, len(subject.expressions)), "photos, expressions"
        ),
        poses=_numbers("start -> poses", start.poses, (views, NUMBERS), "photos, numbers of a pose"),
    )
    for name, values in (("shares", checked.shares), ("expressions", checked.expressions)):
        if values.size and not 0 <= values.min() <= values.max() <= 1:
            raise InputError(f"start -> {name}", f"values {values.min():g} to {values.max():g}, expected 0 to 1")
    for number, (space, pose) in enumerate(zip(spaces, checked.poses, strict=True)):
        camera = space.camera(torch.as_tensor(pose, dtype=torch.float32))
        if not (camera.translation.isfinite().all() and camera.focal.isfinite() and camera.focal > 0):
            raise InputError(f"start -> poses -> photo {number}", "beyond every camera, expected a pose of a head")
    return checked


def _numbers(where: str, values: FloatArray, shape: tuple[int, ...], what: str) -> FloatArray:
    expected = f"expected finite {shape}: {what}"
    _check_array(where, values, "f", expected)
    if values.shape != shape:
        raise InputError(where, f"shape {values.shape}, {expected}")
    if not np.isfinite(values).all():
        raise InputError(where, f"NaN or infinity, {expected}")
    return np.asarray(values, dtype=np.float64)


def check_extractors(extractors: Mapping[Kind, Extractor]) -> None:
    """:raises InputError: a network for no term of the joint loss, or one that doesn't give what it is there for"""
    for kind, extractor in extractors.items():
        where = f"extractors -> {kind}"
        if kind not in FEATURES:
            raise InputError(where, f"no term of the joint loss, expected one of {', '.join(FEATURES)}")
        if not isinstance(extractor, Extractor) or kind not in extractor.kinds:
            gives = (
                f"a network of {', '.join(extractor.kinds)}"
                if isinstance(extractor, Extractor)
                else f"a {type(extractor).__name__}"
            )
            raise InputError(where, f"{gives}, expected a network of {kind} (`load_extractor`)")


def _check_array(where: str, values: object, kinds: str, expected: str) -> None:
    if not isinstance(values, np.ndarray):
        raise InputError(where, f"a {type(values).__name__}, {expected}")
    if values.dtype.kind not in kinds:
        raise InputError(where, f"numbers of type {values.dtype}, {expected}")
