"""Depth maps of photos: found with each neighbour, merged, and kept where other photos see the same."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from facepipe.core.arrays import ByteArray, FloatArray, IntArray
from facepipe.scanning.photos.cameras import PhotoCamera
from facepipe.scanning.photos.photos import Photo
from facepipe.scanning.photos.structure import Structure, Subject

_MARGIN = 0.15  # of what the matched points span, added on every side
_STEP = 16  # numbers of disparities that the matcher takes
_BLOCK = 5  # pixels a side of what is compared
_UNIQUE = 5  # percent by which the best match must beat the second
_SPECKLE = (120, 2)  # pixels of a patch that goes, and the disparity step that ends one
_BOTH_WAYS = 1.0  # pixels: how far the two ways' disparities may be apart
_FIXED = 16.0  # disparities come in sixteenths
_WINDOW = 5  # pixels a side where contrast is measured
_EVERY = 2  # row and column of a depth map becomes a point: the photos show each place of the skin many times


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

    def picture(self, photo: ByteArray, size: tuple[int, int]) -> ByteArray:
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
    # (3, 3) rows: along the line between the eyes, across it, ahead
    x = (right.eye - left.eye) / np.linalg.norm(right.eye - left.eye)
    ahead = left.ahead + right.ahead
    z = ahead - (ahead @ x) * x
    z /= np.linalg.norm(z)
    axes = np.stack([x, np.cross(z, x), z])
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


def _span(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest (k,) of values (n, k), but for a few, and with a margin."""
    low, high = np.percentile(values, (0.5, 99.5), axis=0)
    return low - _MARGIN * (high - low), high + _MARGIN * (high - low)


def disparities(pair: RectifiedPair, left: ByteArray, right: ByteArray) -> tuple[FloatArray, FloatArray]:
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


def _matched(a: ByteArray, b: ByteArray, pair: RectifiedPair) -> FloatArray:
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


def _agreeing(disparity: FloatArray, of_other: FloatArray, columns: IntArray, sign: int) -> FloatArray:
    """`disparity` where the other view's disparity at its match is much the same."""
    match = np.rint(columns + sign * np.nan_to_num(disparity)).astype(np.int64)
    inside = np.isfinite(disparity) & (match >= 0) & (match < disparity.shape[1])
    back = np.take_along_axis(of_other, np.clip(match, 0, disparity.shape[1] - 1), axis=1)
    return np.where(inside & (np.abs(back - disparity) <= _BOTH_WAYS), disparity, np.nan)


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


def depth_maps(
    photos: Sequence[Photo],
    structure: Structure,
    pairs: Sequence[tuple[int, int]],
    agreement: float,
    texture: float,
    step: Callable[[], None],
) -> list[FloatArray]:
    """(h, w) float32 depth along the axis of every camera, NaN where unknown.

    :param photos: in the order of the cameras
    :param pairs: of cameras
    :param agreement: widths of a pixel by which depths may differ that agree
    :param texture: levels of 255: contrast that a place needs to be matched
    :param step: called before every pair
    """
    cameras = list(structure.cameras.values())
    depths: list[list[FloatArray]] = [[] for _ in cameras]
    maps = [np.full((camera.height, camera.width), np.nan, np.float32) for camera in cameras]
    last = {camera: number for number, pair in enumerate(pairs) for camera in pair}
    for number, (a, b) in enumerate(pairs):
        step()
        pair, swapped = rectify(cameras[a], cameras[b], structure.points)
        left, right = (b, a) if swapped else (a, b)
        both = disparities(pair, photos[left].pixels, photos[right].pixels)
        for camera, view, disparity in zip((left, right), (pair.left, pair.right), both, strict=True):
            depth = depth_map(pair, view, disparity, pixel_rays(cameras[camera]))
            depths[camera].append(depth.astype(np.float32))
            if last[camera] == number:  # merged as soon as all are there: together they are large
                merged = _merged(depths[camera], agreement / cameras[camera].focal[0])
                known = merged.reshape(maps[camera].shape)
                photo = photos[camera]
                # (h, w) what the mask shows, without plain places: there the matcher only goes on with what is around.
                # a place beside a plain one is no place either, or surfaces would grow into the backdrop by a strip.
                import cv2

                grey = cv2.cvtColor(photo.pixels, cv2.COLOR_RGB2GRAY).astype(np.float32)
                mean = cv2.blur(grey, (_WINDOW, _WINDOW))
                variance = cv2.blur(grey * grey, (_WINDOW, _WINDOW)) - mean * mean
                rich = cv2.erode((variance >= texture**2).astype(np.uint8), np.ones((_WINDOW, _WINDOW), np.uint8)) > 0
                maps[camera] = np.where(
                    np.asarray(rich if photo.mask is None else rich & photo.mask), known, np.float32(np.nan)
                )
                depths[camera] = []
    return maps


def pixel_rays(camera: PhotoCamera) -> FloatArray:
    """(h * w, 3) rays with z = 1 through the middles of all pixels, row by row."""
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    flat = camera.rays(np.stack([columns.ravel(), rows.ravel()], axis=1))
    return np.column_stack([flat, np.ones(len(flat))])


def _merged(depths: Sequence[FloatArray], share: float) -> FloatArray:
    """(n,) the mean of the depths (n,) that most others agree with, to a share of the depth; NaN where none do.

    A single depth stands where no other is known.
    """
    stack = np.stack(depths)
    best, votes = np.full(stack.shape[1], np.nan, np.float32), np.zeros(stack.shape[1], np.int64)
    known = np.isfinite(stack).sum(axis=0)
    for one in stack:
        near = np.abs(stack - one) <= share * one
        count = near.sum(axis=0)
        mean = np.where(near, stack, 0.0).sum(axis=0) / np.maximum(count, 1)
        better = count > votes
        best[better], votes[better] = mean[better], count[better]
    return np.where((votes >= 2) | (known == 1), best, np.float32(np.nan))


def confirmed(
    number: int,
    maps: Sequence[FloatArray],
    cameras: Sequence[PhotoCamera],
    subject: Subject,
    agreement: float,
    support: int,
) -> tuple[FloatArray, IntArray, FloatArray]:
    """The points (n, 3) of one photo's depth map that lie in the subject and in `support` other depth maps or more,
    their pixels (n, 2), column and row, and their median distance from the others' surfaces along the view (n,).
    """
    camera, depth = cameras[number], maps[number]
    rows, columns = _EVERY * np.array(np.nonzero(np.isfinite(depth[::_EVERY, ::_EVERY])))
    pixels = np.stack([columns, rows], axis=1)
    rays = camera.rays(pixels + 0.5)
    local = np.c_[rays, np.ones(len(rays))] * depth[rows, columns][:, None]
    points = np.asarray((local - camera.translation) @ camera.rotation)
    inside = subject.holds(points)
    points, pixels = points[inside], pixels[inside]
    gaps = np.full((len(cameras), len(points)), np.nan, np.float32)
    for other, one in enumerate(cameras):
        if other != number:  # how far points lie behind its depth map; NaN where that has none
            where = one.project(points)
            shows = np.isfinite(where).all(axis=1) & (where >= 0).all(axis=1)
            shows &= (where[:, 0] < one.width) & (where[:, 1] < one.height)
            column, row = np.where(shows[:, None], where, 0.0).astype(np.int64).T
            gaps[other] = np.where(shows, one.to_camera(points)[:, 2] - maps[other][row, column], np.nan)
    # depth over focal length is a pixel's width there: one tolerance in pixels serves near and far points
    width = agreement * camera.to_camera(points)[:, 2] / camera.focal[0]
    near = np.abs(gaps) <= width
    kept = near.sum(axis=0) >= support
    gaps = np.where(near, np.abs(gaps), np.nan)[:, kept]
    apart = np.nanmedian(gaps, axis=0) if gaps.shape[1] else np.zeros(0)
    return points[kept], pixels[kept], np.asarray(apart)
