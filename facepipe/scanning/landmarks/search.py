"""Where on a scan of any pose and unit there may be a face, and the landmarks of one whose place is roughly known.

Pictures from all around are searched, in crops all over them; then rays of several views meet in the landmarks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.ndimage import maximum_filter

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.geometry.coarse_surface import Look, part_look
from facepipe.geometry.face_crops import bilinear, face_crop, from_crop, turned_crop
from facepipe.geometry.landmarks import MIRRORED
from facepipe.geometry.pinhole import Pinhole, meeting_points

RIGHT_EYE, LEFT_EYE, MOUTH = slice(36, 42), slice(42, 48), slice(48, 68)
# In the crops that the network knows, shares of a side: between the eyes, from eyes to mouth, and from the eyes down to
# the middle of the crop.
_EYES_APART, _EYES_TO_MOUTH, _EYES_TO_MIDDLE = 0.279, 0.295, 0.18
_TILT = 0.27  # radians that the mouth stands before the eyes, on ICT-FaceKit's mean
_INSIDE = 0.22  # of a side: what views turn about lies behind the surface
# A picture (size, size, 3) of sRGB in 0..1 and the depth (size, size), infinite where nothing is.
Draw = Callable[[Look, Pinhole], tuple[FloatArray, FloatArray]]
_AROUND, _STEP = 36, 11  # views from all around, and of how many along their spiral each follows another
_SEARCHED = 224  # pixels a side
_SIDES = (0.28, 0.38, 0.52, 0.72, 1.0)  # of crops, shares of the picture's
_BEYOND = 1 / 3  # of a crop's side: how far crops reach over the picture's edges
_PEAK, _MOST_PEAKS = 0.1, 24  # presence in a map that is worth a crop, and crops of a picture
_MAYBE = 0.5  # presence of such a crop
# Of other faces: what a picture of all must hold beside the first (radius, in its sides), pixels of a side, and at most
# of a picture of what is near, and how many are looked at.
_ROOM, _FACE_PIXELS, _MOST_PIXELS, _MOST_OTHERS = 1.0, 96, 1100, 6
_APART = 0.25  # of a side: of two candidates nearer than this, the surer one
_LOOKED_AT = 208  # pixels a side
MARGIN = 1.6  # sides of a crop that a picture shows
_LOOKS = ((0.0, 1.0), (0.12, 1.0), (-0.12, 1.0), (0.0, 1.12), (0.0, 0.9))  # turn in radians, scale: as of photos
MEETING = 0.012  # of a side: distance at which a ray counts half
_COARSE = 1.5  # pixels of a picture a pixel of a crop: beyond, half the picture is enough


class Network(Protocol):
    """`facepipe.networks.files.LandmarkSession`."""

    size: int  # pixels a side of its crops
    cell: int  # pixels between the windows of a map

    def __call__(self, crops: FloatArray, /) -> tuple[FloatArray, FloatArray]:
        """Landmarks (b, 68, 2) and presence (b,) of crops (b, 3, S, S)."""

    def presence_map(self, level: FloatArray, /) -> FloatArray:
        """(r, c) presence before its sigmoid in windows of a picture (3, h, w)."""


@dataclass(frozen=True, kw_only=True)
class FaceFrame:
    """A face in space."""

    middle: FloatArray  # (3,) of the crop, on the surface
    axes: FloatArray  # (3, 3) rows: the person's left, up, forward
    side: float  # of the crop

    def view(self, yaw: float, pitch: float, size: int, margin: float) -> Pinhole:
        """A view turned to the person's left and up, radians; `margin` crops' sides wide."""
        backward = np.array([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)])
        right = np.array([np.cos(yaw), 0.0, -np.sin(yaw)])
        turned = np.stack([right, np.cross(backward, right), backward]) @ self.axes
        centre = self.middle - _INSIDE * self.side * self.axes[2]
        shown = centre + _INSIDE * self.side * turned[2] * np.cos(yaw) * np.cos(pitch)
        return Pinhole.around(shown, turned, margin * self.side / 2, size, distance=10.0)


def face_frame(landmarks: FloatArray) -> FaceFrame | None:
    """The frame of landmarks (68, 3), rows of NaN where unknown; None where they are too few or don't fit a face."""
    eyes_and_mouth = [landmarks[part] for part in (RIGHT_EYE, LEFT_EYE, MOUTH)]
    if any(np.isfinite(one[:, 0]).sum() < 2 for one in eyes_and_mouth):
        return None
    right, left, mouth = (np.nanmean(one, axis=0) for one in eyes_and_mouth)
    between, down = left - right, mouth - (left + right) / 2
    across = np.linalg.norm(between)
    x = between / max(across, np.finfo(np.float64).tiny)
    # The eyes' line is kept, and the mouth made square to it: a mouth drawn aside does not tilt the frame.
    drop = down - (down @ x) * x
    height = np.linalg.norm(drop)
    if not (0.3 * across < height < 3.0 * across):
        return None
    y = -drop / height
    z = np.cross(x, y)
    y, z = np.cos(_TILT) * y + np.sin(_TILT) * z, np.cos(_TILT) * z - np.sin(_TILT) * y
    side = float(max(across / _EYES_APART, height / _EYES_TO_MOUTH))
    middle = (left + right) / 2 - _EYES_TO_MIDDLE * side * y
    middle = middle + ((mouth - middle) @ z) * z
    return FaceFrame(middle=middle, axes=np.stack([x, y, z]), side=side)


def axis_views(middle: FloatArray, radius: float) -> list[Pinhole]:
    """Along the axes of the file, both ways: most scans stand upright in it."""
    views = []
    for axis, up in ((2, 1), (0, 1), (1, 2)):
        for sign in (1.0, -1.0):
            backward, upward = sign * np.eye(3)[axis], np.eye(3)[up]
            views.append(_view(middle, radius, backward, upward))
    return views


def side_views(middle: FloatArray, radius: float, upward: FloatArray, forward: FloatArray) -> list[Pinhole]:
    """From all sides of what stands upright, the front first."""
    left = np.cross(upward, forward)
    return [
        _view(middle, radius, np.cos(turn) * forward + np.sin(turn) * left, upward)
        for turn in 2 * np.pi * np.array([0, 3, 1, 5, 2, 4]) / 6
    ]


def sphere_views(middle: FloatArray, radius: float) -> list[Pinhole]:
    """From all around, evenly (Fibonacci's spiral), and so that few at the beginning lie all around as well."""
    number = np.arange(_AROUND) * _STEP % _AROUND
    height = 1 - 2 * (number + 0.5) / _AROUND
    turn = np.pi * (1 + 5**0.5) * number
    flat = np.sqrt(1 - height**2)
    directions = np.stack([flat * np.cos(turn), height, flat * np.sin(turn)], axis=1)
    return [_view(middle, radius, direction, np.eye(3)[np.abs(direction).argmin()]) for direction in directions]


def candidates(
    look: Look, views: Sequence[Pinhole], turns: int, draw: Draw, network: Network, most: int
) -> list[tuple[float, FaceFrame]]:
    """The surest faces, at most `most`: their presence, and the frames of crops that may show them.

    :param turns: of crops in the picture's plane, evenly over the circle
    """
    faces: list[tuple[float, FaceFrame]] = []
    for view in views:
        picture, depth = draw(look, view)
        if not np.isfinite(depth).any():
            continue
        for present, where in faces_in(picture, turns, _SIDES, network):
            frame = _in_space(where, view, depth)
            if frame is not None:
                faces.append((present, frame))
    return _apart(faces, most)


def other_faces(look: Look, frame: FaceFrame, draw: Draw, network: Network) -> list[FaceFrame]:
    """Faces of a size like one at `frame` that may be elsewhere, from the front, the back and the sides of that."""
    middle = (look.points.min(axis=0) + look.points.max(axis=0)) / 2
    radius = float(np.linalg.norm(look.points - middle, axis=1).max())
    if radius < _ROOM * frame.side:
        return []
    reach = _MOST_PIXELS / (2 * _FACE_PIXELS) * frame.side
    if radius > reach:  # of a scene: what is near the face
        look = part_look(look, np.linalg.norm(look.points - frame.middle, axis=1) < reach)
        middle, radius = frame.middle, reach
    share = frame.side / (2 * radius)
    pixels = 2 * int(max(_FACE_PIXELS / share, _SEARCHED) / 2)
    x, y, z = frame.axes
    found = []
    for backward in (z, x, -x, -z):
        view = Pinhole.around(middle, np.stack([np.cross(y, backward), y, backward]), radius, pixels)
        picture, depth = draw(look, view)
        for _, where in faces_in(picture, 1, [factor * share for factor in (0.75, 1.0, 1.35)], network):
            other = _in_space(where, view, depth)
            if other is not None and np.linalg.norm(other.middle - frame.middle) > frame.side / 2:
                found.append((1.0, other))
    return [one for _, one in _apart(found, _MOST_OTHERS)]


def _in_space(where: FloatArray, view: Pinhole, depth: FloatArray) -> FaceFrame | None:
    """The frame of landmarks (68, 2) where the rays through them meet a surface; None where too many miss it."""
    column, row = np.floor(where).astype(np.int64).T
    inside = (column >= 0) & (row >= 0) & (column < view.size) & (row < view.size)
    far = np.full(len(where), np.inf)
    far[inside] = depth[row[inside], column[inside]]
    far[~np.isfinite(far)] = np.nan
    return face_frame(np.asarray(view.eye + far[:, None] * view.directions(where)))


def faces_in(
    picture: FloatArray, turns: int, sides: Sequence[float], network: Network
) -> list[tuple[float, FloatArray]]:
    """Presence and landmarks (68, 2), in pixels, of crops of a square picture that may show a face, the surest first.

    The network's map sees all places of a crop of one size and turn at once, for a tenth of what those crops take one
    by one; crops at its peaks are then looked at themselves.

    :param sides: of crops, shares of the picture's
    """
    size, count, source = network.size, len(picture), _Picture(picture)
    crops: list[FloatArray] = [np.zeros((0, 2, 3))]
    peaks: list[FloatArray] = [np.zeros(0)]
    for share in sides:
        scale = share * count / size  # pixels of the picture a pixel of the map's
        pixels = -(-int(count / scale + 2 * _BEYOND * size) // network.cell) * network.cell
        for turn in range(turns):
            level = turned_crop(_middle_crop(count, scale, pixels), 2 * np.pi * turn / turns, 1.0, pixels)
            found = network.presence_map(source.crops(level[None], pixels)[0])
            peak = (found > np.log(_PEAK / (1 - _PEAK))) & (found == maximum_filter(found, 3))
            corners = np.argwhere(peak)[:, ::-1] * network.cell
            matrices = np.repeat(level[None], len(corners), axis=0)
            matrices[:, :, 2] += corners @ level[:, :2].T
            crops.append(matrices)
            peaks.append(found[peak])
    matrices = np.concatenate(crops)[np.argsort(-np.concatenate(peaks), kind="stable")[:_MOST_PEAKS]]
    if not len(matrices):
        return []
    landmarks, presence = network(source.crops(matrices, size))
    sure = np.flatnonzero(presence > _MAYBE)
    sure = sure[np.argsort(-presence[sure], kind="stable")]
    return list(zip(presence[sure].tolist(), map(from_crop, landmarks[sure], matrices[sure]), strict=True))


def _view(middle: FloatArray, radius: float, backward: FloatArray, upward: FloatArray) -> Pinhole:
    right = np.cross(upward, backward)
    right /= np.linalg.norm(right)
    return Pinhole.around(middle, np.stack([right, np.cross(backward, right), backward]), radius, _SEARCHED)


def _apart(faces: list[tuple[float, FaceFrame]], most: int) -> list[tuple[float, FaceFrame]]:
    kept: list[tuple[float, FaceFrame]] = []
    for presence, frame in sorted(faces, key=lambda face: -face[0]):
        if len(kept) == most:
            break
        for _, other in kept:
            far = np.linalg.norm(frame.middle - other.middle) > _APART * other.side
            turned = np.trace(frame.axes @ other.axes.T) < 1 + 2 * np.cos(0.6)
            if not (far or turned or not 0.7 < frame.side / other.side < 1.4):
                break
        else:
            kept.append((presence, frame))
    return kept


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
) -> Seen:
    """Landmarks by views at `angles`: yaw and pitch in radians."""
    views = [frame.view(yaw, pitch, _LOOKED_AT, MARGIN) for yaw, pitch in angles]
    seen = [_one_view(look, view, draw, network) for view in views]
    presence = np.array([one[1] for one in seen])
    directions = np.stack([view.directions(one[0]) for view, one in zip(views, seen, strict=True)])
    weights = np.repeat(np.maximum(presence, 1e-3)[:, None], 68, axis=1)
    origins = np.stack([view.eye for view in views])
    places, distances = meeting_points(origins, directions, weights, MEETING * frame.side)
    return Seen(landmarks=places, spread=np.median(distances, axis=0) / frame.side, presence=float(presence.mean()))


def _one_view(look: Look, view: Pinhole, draw: Draw, network: Network) -> tuple[FloatArray, float]:
    """Landmarks (68, 2) in pixels, and presence: of the middle first, then of crops aligned by what that showed."""
    size, source = network.size, _Picture(draw(look, view)[0])
    matrix = _middle_crop(_LOOKED_AT, _LOOKED_AT / MARGIN / size, size)
    for _ in range(2):
        landmarks, presence = network(source.crops(matrix[None], size))
        found = from_crop(landmarks[0], matrix)
        try:
            matrix = face_crop(found, size)
        except InputError:
            return found, 0.0
    matrices = np.stack([turned_crop(matrix, turn, scale, size) for turn, scale in _LOOKS])
    crops = source.crops(matrices, size)
    landmarks, presence = network(np.concatenate([crops, crops[..., ::-1]]))
    # Means with mirrored crops: what the network errs to one side cancels.
    other = landmarks[len(crops) :][:, MIRRORED]
    other[..., 0] = size - other[..., 0]
    both = (landmarks[: len(crops)] + other) / 2
    return np.mean(list(map(from_crop, both, matrices)), axis=0), float(presence.mean())


def _middle_crop(count: int, scale: float, size: int) -> FloatArray:
    """(2, 3) from crop pixels to pixels of a picture of `count` a side: about its middle, `scale` of those a pixel."""
    return np.column_stack([scale * np.eye(2), np.full(2, (count - scale * size) / 2)])


class _Picture:
    """A square picture that crops are cut from; those of large scale from one of half the size."""

    def __init__(self, pixels: FloatArray) -> None:
        """
        :param pixels: (h, h, 3), h even
        """
        whole = np.asarray(pixels, np.float32)
        half = sum(whole[row::2, column::2] for row in (0, 1) for column in (0, 1)) / 4
        self._levels = whole, np.asarray(half, np.float32)

    def crops(self, matrices: FloatArray, size: int) -> FloatArray:
        """(k, 3, size, size) float32 by matrices (k, 2, 3), bilinear; outside, the picture's border."""
        crops = np.empty((len(matrices), 3, size, size), np.float32)
        for crop, matrix in zip(crops, matrices, strict=True):
            halved = int(np.linalg.norm(matrix[:, 0]) > _COARSE)
            crop[:] = bilinear(self._levels[halved], matrix / (1 + halved), size).transpose(2, 0, 1)
        return crops
