"""Photos in which a face lies on its side or stands on its head: fitted upright, and turned back.

A fit is not the same from all sides: poses are steps away from an upright one, windows and the pixels that a renderer
covers follow rows and columns. By quarter turns all of it is what the upright photo has.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from facepipe.core.arrays import FloatArray
from facepipe.geometry.landmarks import quarter_turned, quarters_to_upright
from facepipe.photo.descent.landmark_fit import State
from facepipe.photo.descent.result import FittedCamera, FittedView

# A clockwise quarter turn: the harmonic that each of the nine comes from, and its sign (`renderer.light.basis`)
_HARMONICS = [0, 3, 2, 1, 4, 7, 6, 5, 8]
_SIGNS = np.array((1, -1, 1, 1, -1, -1, 1, 1, -1))
_GRID = 1024  # to a pixel: landmarks on it are the same numbers however often they are turned


@dataclass(frozen=True, kw_only=True)
class UprightPhotos:
    """Photos turned counter-clockwise by quarters, each until its face is within 45 degrees of upright.

    A fit carries last digits of where it starts to first ones of where it ends: a photo and the same one on its side
    must have the same landmarks to the last digit.
    """

    photos: tuple[FloatArray, ...]  # (h, w, 3)
    landmarks: tuple[FloatArray, ...]  # (68, 2) pixels
    quarters: tuple[int, ...]

    @classmethod
    def from_photos(cls, photos: Sequence[FloatArray], landmarks: Sequence[FloatArray]) -> UprightPhotos:
        """:param photos: as they are, (h, w, 3)"""
        quarters = tuple(map(quarters_to_upright, landmarks))
        turned = [np.ascontiguousarray(np.rot90(*pair)) for pair in zip(photos, quarters, strict=True)]
        each = zip(landmarks, quarters, map(_size, photos), strict=True)
        marks = tuple(np.round(quarter_turned(*one) * _GRID) / _GRID for one in each)
        return cls(photos=tuple(turned), landmarks=marks, quarters=quarters)

    def start(self, start: State) -> State:
        """A state of the photos as they were, as one of these."""
        poses = start.poses.copy()
        for pose, photo, quarters in zip(poses, self.photos, self.quarters, strict=True):
            if quarters:
                width, height = _size(photo)
                before, side = (height, width) if quarters % 2 else (width, height), max(width, height)
                pose[:3] = (_about_axis(quarters) * Rotation.from_rotvec(pose[:3])).as_rotvec()
                pose[3:5] = quarter_turned(pose[3:5] * side, quarters, before) / side
        return replace(start, poses=poses)

    def turned_back(self, views: Sequence[FittedView]) -> tuple[FittedView, ...]:
        """Views of these, as views of the photos as they were."""
        each = zip(views, self.quarters, map(_size, self.photos), strict=True)
        return tuple(_turned_back(view, quarters, size) if quarters else view for view, quarters, size in each)


def _turned_back(view: FittedView, quarters: int, size: tuple[int, int]) -> FittedView:
    turn, camera, light = _about_axis(-quarters), view.camera, view.light
    for _ in range(quarters):
        light = _SIGNS[:, None] * light[_HARMONICS]
    x, y = quarter_turned(np.array(camera.center), -quarters, size)
    return replace(
        view,
        camera=FittedCamera(
            rotation=(turn * Rotation.from_rotvec(camera.rotation)).as_rotvec(),
            translation=turn.apply(camera.translation),
            focal=camera.focal,
            center=(float(x), float(y)),
        ),
        light=light,
        key=np.concatenate([turn.apply(view.key[:3]), view.key[3:]]),
        landmarks=quarter_turned(view.landmarks, -quarters, size),
        targets=quarter_turned(view.targets, -quarters, size),
    )


def _about_axis(quarters: int) -> Rotation:
    """Of camera coordinates, counter-clockwise as the photo shows it."""
    return Rotation.from_rotvec([0.0, 0.0, quarters * np.pi / 2])


def _size(photo: FloatArray) -> tuple[int, int]:
    """Width and height."""
    return photo.shape[1], photo.shape[0]
