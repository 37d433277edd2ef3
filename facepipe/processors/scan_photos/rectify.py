"""Two photos turned so that a point of the skin shows in the same row of both."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray
from facepipe.processors.scan_photos.camera import PhotoCamera

Pixels = npt.NDArray[np.uint8]

_MARGIN = 0.15  # of what the matched points span, added on every side
_STEP = 16  # numbers of disparities that the matcher takes


@dataclass(frozen=True, kw_only=True)
class RectifiedView:
    """One of two rectified pictures: a camera at the eye of a photo's, turned, without distortion."""

    camera: PhotoCamera  # of the photo
    turn: FloatArray  # (3, 3) camera -> rectified
    focal: float  # pixels
    origin: FloatArray  # (2,) pixels of the principal point

    def pixels(self, rays: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n, 2) rectified pixels of rays (n, 3) in camera coordinates, and the rays' rectified depth (n,)."""
        local = rays @ self.turn.T
        return self.focal * local[:, :2] / local[:, 2:] + self.origin, local[:, 2]

    def picture(self, photo: Pixels, size: tuple[int, int]) -> Pixels:
        """(h, w) or (h, w, c) of a photo (rows, columns) or with channels; black beyond its borders."""
        import cv2

        width, height = size
        columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        flat = np.stack([columns - self.origin[0], rows - self.origin[1]], axis=-1).reshape(-1, 2) / self.focal
        local = np.c_[flat, np.ones(len(flat))] @ self.turn
        seen = self.camera.bend(local[:, :2] / local[:, 2:]) * self.camera.focal + self.camera.center - 0.5
        x, y = seen.T.reshape(2, height, width).astype(np.float32)
        turned: Any = cv2.remap(photo, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
        return np.asarray(turned)


@dataclass(frozen=True, kw_only=True)
class RectifiedPair:
    """Two rectified views of one size. Points at infinity have disparity `infinity`, near ones more.

    A point at the left view's (u, v) with disparity d is at (u - d, v) in the right one, and its rectified depth is
    ``focal * baseline / (d - infinity)``.
    """

    left: RectifiedView
    right: RectifiedView
    size: tuple[int, int]  # width and height
    baseline: float  # scan units
    lowest: int  # disparity
    count: int  # of disparities, a multiple of 16

    @property
    def infinity(self) -> float:
        """Disparity of points at infinity."""
        return float(self.left.origin[0] - self.right.origin[0])

    def depth(self, disparity: FloatArray) -> FloatArray:
        """Rectified depth of disparities; NaN of NaN, and at infinity or beyond."""
        ahead = np.where(disparity > self.infinity, disparity - self.infinity, np.nan)
        return np.asarray(self.left.focal * self.baseline / ahead)


def rectify(a: PhotoCamera, b: PhotoCamera, points: FloatArray) -> tuple[RectifiedPair, bool]:
    """Rectified views of two cameras that hold `points` (n, 3) and some margin, and whether `b` is the left one.

    The common axes are the line between the eyes and, at right angles, the mean of the views (Fusiello, Trucco and
    Verri, "A compact algorithm for rectification of stereo pairs", 2000); the principal points are where they make
    the pictures smallest, so that disparities count from the farthest point.
    """
    swapped = float((b.eye - a.eye) @ (a.rotation[0] + b.rotation[0] + a.rotation[1] + b.rotation[1])) < 0
    left, right = (b, a) if swapped else (a, b)
    axes = _axes(left, right)
    focal = 0.25 * sum((*left.focal, *right.focal))
    spans = []
    for camera in (left, right):
        local = (points - camera.eye) @ axes.T
        spans.append(_span(focal * local[:, :2] / local[:, 2:]))
    low, high = np.array(spans).transpose(1, 0, 2)  # (side, uv)
    top, bottom = low[:, 1].min(), high[:, 1].max()
    shift = np.array([-np.floor(low[0, 0]), -np.floor(top)]), np.array([-np.floor(low[1, 0]), -np.floor(top)])
    views = [
        RectifiedView(camera=one, turn=axes @ one.rotation.T, focal=focal, origin=origin)
        for one, origin in zip((left, right), shift, strict=True)
    ]
    width = int(np.ceil(max(high[:, 0] - low[:, 0]))) + 1
    baseline = float(np.linalg.norm(right.eye - left.eye))
    disparity = _span((focal * baseline / ((points - left.eye) @ axes[2]))[:, None])
    infinity = shift[0][0] - shift[1][0]
    lowest = int(np.floor(disparity[0][0] + infinity))
    count = int(np.ceil((disparity[1][0] + infinity - lowest + 1) / _STEP)) * _STEP
    pair = RectifiedPair(
        left=views[0],
        right=views[1],
        size=(width, int(np.ceil(bottom - top)) + 1),
        baseline=baseline,
        lowest=lowest,
        count=count,
    )
    return pair, swapped


def _axes(left: PhotoCamera, right: PhotoCamera) -> FloatArray:
    """(3, 3) rows: along the line between the eyes, across it, ahead."""
    x = (right.eye - left.eye) / np.linalg.norm(right.eye - left.eye)
    ahead = left.ahead + right.ahead
    z = ahead - (ahead @ x) * x
    z /= np.linalg.norm(z)
    return np.stack([x, np.cross(z, x), z])


def _span(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest (k,) of values (n, k), but for a few, and with a margin."""
    low, high = np.percentile(values, (0.5, 99.5), axis=0)
    return low - _MARGIN * (high - low), high + _MARGIN * (high - low)
