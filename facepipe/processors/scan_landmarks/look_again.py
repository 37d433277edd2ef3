"""Landmarks of a face whose place is roughly known: pictures of it from several sides, and where their rays meet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.geometry.coarse_surface import Look
from facepipe.geometry.pinhole import Pinhole, meeting_points
from facepipe.processors.scan_landmarks.crops import crop_matrix, cut_crops, in_picture
from facepipe.processors.scan_landmarks.frame import FaceFrame
from facepipe.processors.scan_landmarks.search import Draw, Network

_PICTURE = 208  # pixels a side
_MARGIN = 1.6  # sides of a crop that a picture shows
_LOOKS = ((0.0, 1.0), (0.12, 1.0), (-0.12, 1.0), (0.0, 1.12), (0.0, 0.9))  # turn in radians, scale: as of photos
_MEETING = 0.012  # of a side: distance at which a ray counts half

# The landmarks of the other side.
_JAW, _BROWS, _NOSE = range(16, -1, -1), range(26, 16, -1), (27, 28, 29, 30, 35, 34, 33, 32, 31)
_EYES = (45, 44, 43, 42, 47, 46, 39, 38, 37, 36, 41, 40)
_LIPS = (54, 53, 52, 51, 50, 49, 48, 59, 58, 57, 56, 55, 64, 63, 62, 61, 60, 67, 66, 65)
MIRRORED = np.array([*_JAW, *_BROWS, *_NOSE, *_EYES, *_LIPS])


@dataclass(frozen=True, kw_only=True)
class Seen:
    """Landmarks in space, by several views."""

    landmarks: FloatArray  # (68, 3)
    spread: FloatArray  # (68,) median distance of the rays, as a share of the crop's side
    presence: float  # mean over the views


def look_again(
    look: Look,
    frame: FaceFrame,
    angles: Sequence[tuple[float, float]],
    draw: Draw,
    network: Network,
    size: int,
) -> Seen:
    """Landmarks by views at `angles`: yaw and pitch in radians."""
    views = [frame.view(yaw, pitch, _PICTURE, _MARGIN) for yaw, pitch in angles]
    seen = [_one_view(look, view, draw, network, size) for view in views]
    presence = np.array([one[1] for one in seen])
    directions = np.stack([view.directions(one[0]) for view, one in zip(views, seen, strict=True)])
    weights = np.repeat(np.maximum(presence, 1e-3)[:, None], 68, axis=1)
    origins = np.stack([view.eye for view in views])
    places, distances = meeting_points(origins, directions, weights, _MEETING * frame.side)
    return Seen(landmarks=places, spread=np.median(distances, axis=0) / frame.side, presence=float(presence.mean()))


def _one_view(look: Look, view: Pinhole, draw: Draw, network: Network, size: int) -> tuple[FloatArray, float]:
    """Landmarks (68, 2) in pixels, and presence: of the middle first, then of crops aligned by what that showed."""
    from facepipe.core.errors import InputError
    from facepipe.learn.features.crops import face_crop

    picture, _ = draw(look, view)
    matrix = crop_matrix(np.full(2, _PICTURE / 2), _PICTURE / _MARGIN, 0.0, size)
    for _ in range(2):
        landmarks, presence = network(cut_crops(picture, matrix[None], size))
        try:
            matrix = face_crop(in_picture(landmarks, matrix[None])[0], size)
        except InputError:
            return in_picture(landmarks, matrix[None])[0], 0.0
    matrices = np.stack([_turned(matrix, turn, scale, size) for turn, scale in _LOOKS])
    crops = cut_crops(picture, matrices, size)
    landmarks, presence = network(np.concatenate([crops, crops[..., ::-1]]))
    other = landmarks[len(crops) :][:, MIRRORED]
    other[..., 0] = size - other[..., 0]
    both = (landmarks[: len(crops)] + other) / 2
    return in_picture(both, matrices).mean(axis=0), float(presence.mean())


def _turned(matrix: FloatArray, turn: float, scale: float, size: int) -> FloatArray:
    """The crop turned and scaled about its centre."""
    centre = matrix[:, :2] @ np.full(2, size / 2) + matrix[:, 2]
    linear = scale * matrix[:, :2] @ np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    return np.column_stack([linear, centre - linear @ np.full(2, size / 2)])
