"""Where on a scan of any pose and unit there may be a face: pictures from all around, crops all over them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.geometry.coarse_surface import Look
from facepipe.geometry.pinhole import Pinhole
from facepipe.processors.scan_landmarks.crops import crop_matrix, cut_crops, in_picture
from facepipe.processors.scan_landmarks.frame import FaceFrame, face_frame

# A picture (size, size, 3) of sRGB in 0..1 and the depth (size, size), infinite where nothing is.
Draw = Callable[[Look, Pinhole], tuple[FloatArray, FloatArray]]
# Landmarks (b, 68, 2) and presence (b,) of crops (b, 3, S, S).
Network = Callable[[FloatArray], tuple[FloatArray, FloatArray]]

PICTURE = 224  # pixels a side
_SIDES = (0.28, 0.38, 0.52, 0.72, 1.0)  # of crops, shares of the picture's
_STRIDE = 0.25  # of a crop's side
_COVERED = 0.5  # share of a crop that must show the scan
_MAYBE = 0.5  # presence
_APART = 0.25  # of a side: of two candidates nearer than this, the surer one


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """A crop that may show a face."""

    presence: float
    frame: FaceFrame


def axis_views(middle: FloatArray, radius: float) -> list[Pinhole]:
    """Along the axes of the file, both ways: most scans stand upright in it."""
    views = []
    for axis, up in ((2, 1), (0, 1), (1, 2)):
        for sign in (1.0, -1.0):
            backward, upward = sign * np.eye(3)[axis], np.eye(3)[up]
            views.append(_view(middle, radius, backward, upward))
    return views


def sphere_views(middle: FloatArray, radius: float, count: int = 36) -> list[Pinhole]:
    """From all around, evenly (Fibonacci's spiral)."""
    height = 1 - 2 * (np.arange(count) + 0.5) / count
    turn = np.pi * (1 + 5**0.5) * np.arange(count)
    flat = np.sqrt(1 - height**2)
    directions = np.stack([flat * np.cos(turn), height, flat * np.sin(turn)], axis=1)
    return [_view(middle, radius, one, np.eye(3)[np.abs(one).argmin()]) for one in directions]


def candidates(
    look: Look, views: Sequence[Pinhole], turns: int, draw: Draw, network: Network, size: int, most: int
) -> list[Candidate]:
    """The surest faces, at most `most`.

    :param turns: of crops in the picture's plane, evenly over the circle
    :param size: pixels a side of the network's crops
    """
    found: list[Candidate] = []
    for view in views:
        picture, depth = draw(look, view)
        matrices = _grid(np.isfinite(depth), turns, size)
        if not len(matrices):
            continue
        landmarks, presence = network(cut_crops(picture, matrices, size))
        sure = np.flatnonzero(presence > _MAYBE)
        sure = sure[np.argsort(-presence[sure], kind="stable")][: 4 * most]
        places = in_picture(landmarks[sure], matrices[sure])
        for where, present in zip(places, presence[sure], strict=True):
            frame = face_frame(lifted(where, depth, view))
            if frame is not None:
                found.append(Candidate(presence=float(present), frame=frame))
    return _apart(found, most)


def lifted(landmarks: FloatArray, depth: FloatArray, view: Pinhole) -> FloatArray:
    """(68, 3) where the rays through landmarks (68, 2) meet the surface; NaN where they miss it."""
    column, row = np.floor(landmarks).astype(np.int64).T
    inside = (column >= 0) & (row >= 0) & (column < view.size) & (row < view.size)
    far = np.full(len(landmarks), np.inf)
    far[inside] = depth[row[inside], column[inside]]
    far[~np.isfinite(far)] = np.nan
    return np.asarray(view.eye + far[:, None] * view.directions(landmarks))


def _view(middle: FloatArray, radius: float, backward: FloatArray, upward: FloatArray) -> Pinhole:
    right = np.cross(upward, backward)
    right /= np.linalg.norm(right)
    return Pinhole.around(middle, np.stack([right, np.cross(backward, right), backward]), radius, PICTURE)


def _grid(covered: FloatArray, turns: int, size: int) -> FloatArray:
    """(k, 2, 3) crops of all sizes, turns and places that show enough of the scan."""
    count = covered.shape[0]
    sums = np.pad(np.cumsum(np.cumsum(covered, axis=0), axis=1), ((1, 0), (1, 0)))
    matrices = []
    for share in _SIDES:
        side = share * count
        steps = max(int(np.ceil((count - side) / (_STRIDE * side))) + 1, 1)
        starts = np.round(np.linspace(0, count - side, steps)).astype(np.int64)
        width = round(side)
        for row in starts:
            for column in starts:
                seen = sums[row + width, column + width] - sums[row, column + width] - sums[row + width, column]
                if seen + sums[row, column] >= _COVERED * width**2:
                    middle = np.array([column + side / 2, row + side / 2])
                    matrices += [crop_matrix(middle, side, 2 * np.pi * turn / turns, size) for turn in range(turns)]
    return np.array(matrices).reshape(-1, 2, 3)


def _apart(found: list[Candidate], most: int) -> list[Candidate]:
    kept: list[Candidate] = []
    for one in sorted(found, key=lambda each: -each.presence):
        if len(kept) == most:
            break
        if all(_differ(one.frame, other.frame) for other in kept):
            kept.append(one)
    return kept


def _differ(one: FaceFrame, other: FaceFrame) -> bool:
    far = np.linalg.norm(one.middle - other.middle) > _APART * other.side
    turned = np.trace(one.axes @ other.axes.T) < 1 + 2 * np.cos(0.6)
    return bool(far or turned or not 0.7 < one.side / other.side < 1.4)
