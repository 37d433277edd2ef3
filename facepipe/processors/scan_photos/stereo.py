"""Depth of two rectified photos: semi-global matching by OpenCV, both ways."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray
from facepipe.processors.scan_photos.rectify import RectifiedPair, RectifiedView

Pixels = npt.NDArray[np.uint8]

_BLOCK = 5  # pixels a side of what is compared
_UNIQUE = 5  # percent by which the best match must beat the second
_SPECKLE = (120, 2)  # pixels of a patch that goes, and the disparity step that ends one
_BOTH_WAYS = 1.0  # pixels: how far the two ways' disparities may be apart
_FIXED = 16.0  # disparities come in sixteenths


def disparities(pair: RectifiedPair, left: Pixels, right: Pixels) -> tuple[FloatArray, FloatArray]:
    """(h, w) disparities of the left and of the right photo's pixels; NaN where the two ways don't agree.

    Hirschmüller, "Stereo processing by semiglobal matching and mutual information", PAMI 2008.

    :param left: (rows, columns, 3) the photo, and likewise `right`
    """
    a, b = pair.left.picture(left, pair.size), pair.right.picture(right, pair.size)
    from_left = _matched(a, b, pair)
    from_right = _matched(b[:, ::-1], a[:, ::-1], pair)[:, ::-1]  # mirrored, the right one is the left one
    width = pair.size[0]
    columns = np.arange(width)[None, :]
    return _agreeing(from_left, from_right, columns, -1), _agreeing(from_right, from_left, columns, 1)


def _matched(a: Pixels, b: Pixels, pair: RectifiedPair) -> FloatArray:
    """(h, w) disparities of `a`; NaN where no match is found."""
    import cv2

    # room for matches beyond the left and right borders, which the matcher leaves out otherwise
    before, after = max(0, pair.lowest + pair.count), max(0, -pair.lowest)
    a, b = (
        cv2.copyMakeBorder(np.ascontiguousarray(one), 0, 0, before, after, cv2.BORDER_CONSTANT, value=0)
        for one in (a, b)
    )
    channels = a.shape[2]
    matcher = cv2.StereoSGBM.create(
        minDisparity=pair.lowest,
        numDisparities=pair.count,
        blockSize=_BLOCK,
        P1=8 * channels * _BLOCK**2,
        P2=32 * channels * _BLOCK**2,
        uniquenessRatio=_UNIQUE,
        speckleWindowSize=_SPECKLE[0],
        speckleRange=_SPECKLE[1],
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    found = matcher.compute(a, b).astype(np.float32)[:, before : before + pair.size[0]] / _FIXED
    return np.where(found < pair.lowest, np.nan, found)


def _agreeing(own: FloatArray, other: FloatArray, columns: npt.NDArray[np.integer], sign: int) -> FloatArray:
    """`own` where the other view's disparity at its match is much the same."""
    match = np.rint(columns + sign * np.nan_to_num(own)).astype(np.int64)
    inside = np.isfinite(own) & (match >= 0) & (match < own.shape[1])
    back = np.take_along_axis(other, np.clip(match, 0, own.shape[1] - 1), axis=1)
    return np.where(inside & (np.abs(back - own) <= _BOTH_WAYS), own, np.nan)


def depth_map(pair: RectifiedPair, view: RectifiedView, disparity: FloatArray, rays: FloatArray) -> FloatArray:
    """(n,) depth along the camera's axis where rays (n, 3), with z = 1, meet the surface; NaN where it is unknown.

    :param disparity: (h, w) of that view's pixels
    """
    where, ahead = view.pixels(rays)
    return np.asarray(pair.depth(_sampled(disparity, where - 0.5)) / ahead)


def _sampled(values: FloatArray, where: FloatArray) -> FloatArray:
    """(n,) values (h, w) between four pixels, NaN where one of them is or they are on both sides of an edge."""
    height, width = values.shape
    inside = (where >= 0).all(axis=1) & (where[:, 0] < width - 1) & (where[:, 1] < height - 1)
    column, row = np.where(inside[:, None], where, 0.0).T
    x, y = np.minimum(column.astype(np.int64), width - 2), np.minimum(row.astype(np.int64), height - 2)
    fx, fy = column - x, row - y
    corners = np.stack([values[y, x], values[y, x + 1], values[y + 1, x], values[y + 1, x + 1]])
    shares = np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy])
    smooth = np.ptp(corners, axis=0) <= 2.0
    return np.where(inside & smooth, (corners * shares).sum(axis=0), np.nan)
