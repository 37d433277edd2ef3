"""What one frame shows of a face: its turn, how sharp it is, lids and lips, how sure its landmarks are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_laplace

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.geometry.face_crops import face_crop
from facepipe.geometry.landmarks import face_size, turned_view
from facepipe.heads.asset import asset
from facepipe.networks import FoundFace
from facepipe.networks.crops import sample_crop
from facepipe.photo.fit import check_face
from facepipe.rig.torch import torch

_SIZE = 192  # pixels a side of the crop that sharpness is measured in, of which brows to chin are 0.6
_FACE = slice(round(0.18 * _SIZE), round(0.82 * _SIZE))
_GRAIN = 1.2  # crop pixels: finer detail is mostly noise
_LUMA = np.array((0.2126, 0.7152, 0.0722))
_CONTOUR = 17  # of the landmarks; that of a turned head is elsewhere on it
_LIDS = (((37, 41), (38, 40)), ((43, 47), (44, 46)))  # upper, lower
_LIPS = ((61, 67), (62, 66), (63, 65))
_LEAST_CONFIDENCE = 0.01


@dataclass(frozen=True, kw_only=True)
class Look:
    """A face in a frame."""

    number: int  # of the frame
    time: float  # seconds
    yaw: float  # radians, to the person's left
    pitch: float  # radians, up
    sharpness: float  # of detail in the face, over its brightness
    lids: float  # how far they are open, over the face's size: the mean of both eyes
    lips: float  # how far they are apart, likewise
    error: float  # to expect of a landmark, over that of one that is sure


def look_at(picture: FloatArray, face: FoundFace, number: int, time: float) -> Look | None:
    """The face of a picture (h, w, 3) of sRGB 0..1; None where its landmarks are no face's, or it is cut off."""
    marks, (height, width) = face.landmarks, picture.shape[:2]
    try:
        check_face(marks, "")
        sharp = sharpness(picture, marks)
    except InputError:
        return None
    if (marks < 0).any() or (marks > (width, height)).any():
        return None
    yaw, pitch = turn(marks)
    size = face_size(marks)
    return Look(
        number=number,
        time=time,
        yaw=yaw,
        pitch=pitch,
        sharpness=sharp,
        lids=float(np.mean([_gap(marks, pairs) for pairs in _LIDS])) / size,
        lips=_gap(marks, _LIPS) / size,
        error=float(np.sqrt(1 / np.maximum(face.confidence, _LEAST_CONFIDENCE)).mean()),
    )


def sharpness(picture: FloatArray, landmarks: FloatArray) -> float:
    """How much detail a face has in a picture (h, w, 3), as large as all others: the Laplacian's spread over the mean.

    :raises InputError: landmarks that are no face's
    """
    crop = sample_crop(torch.as_tensor(picture), face_crop(landmarks, _SIZE), _SIZE)[0]
    luma = crop.numpy().transpose(1, 2, 0) @ _LUMA
    detail = gaussian_laplace(luma, _GRAIN)[_FACE, _FACE]
    return float(detail.std() / max(float(luma[_FACE, _FACE].mean()), 0.02))


def turn(landmarks: FloatArray) -> tuple[float, float]:
    """Yaw to the person's left and pitch upwards, radians, of a head with (68, 2) landmarks; however it is rolled."""
    head = asset()
    view = turned_view(head.points[head.landmarks][_CONTOUR:], landmarks[_CONTOUR:])
    right, down = view / np.linalg.norm(view, axis=1, keepdims=True)
    ahead = np.cross(right, -down)
    # a face that looks at the camera looks along its own z; the camera, from the head, is where `ahead` points
    return float(-np.arctan2(ahead[0], ahead[2])), float(-np.arcsin(np.clip(ahead[1], -1, 1)))


def _gap(marks: FloatArray, pairs: tuple[tuple[int, int], ...]) -> float:
    return float(np.mean([np.linalg.norm(marks[upper] - marks[lower]) for upper, lower in pairs]))
