"""Square crops of a face, brought by its landmarks to where a network expects them.

Landmarks are the 68 of Multi-PIE. Pixels count from the top left corner of an image, x right and y down; the first
pixel's centre is (0.5, 0.5). A crop is given by a matrix (2, 3) from crop pixels to image pixels, so that a photo and a
render of it are read at the same places.
"""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import Float32Array, FloatArray, IntArray
from facepipe.core.errors import InputError

ARCFACE_SIZE = 112  # pixels a side that the five points are given for

# x, y in the unit square, top left origin: the neutral of ICT-FaceKit (MIT, Copyright (c) 2020 USC Institute for
# Creative Technologies) from the front without perspective; brows to chin are 0.6 high, the middle of that at 0.5.
_JAW = (
    *((0.1804, 0.3119), (0.1842, 0.4068), (0.1988, 0.4916), (0.2154, 0.5738), (0.2515, 0.6663), (0.3132, 0.7410)),
    *((0.3676, 0.7716), (0.4333, 0.7866), (0.5000, 0.8000), (0.5667, 0.7866), (0.6324, 0.7716), (0.6868, 0.7410)),
    *((0.7485, 0.6663), (0.7846, 0.5738), (0.8012, 0.4916), (0.8158, 0.4068), (0.8196, 0.3119)),
)
_BROWS = (
    *((0.2476, 0.2459), (0.2859, 0.2121), (0.3353, 0.2000), (0.3952, 0.2028), (0.4491, 0.2151)),
    *((0.5509, 0.2151), (0.6048, 0.2028), (0.6647, 0.2000), (0.7141, 0.2121), (0.7524, 0.2459)),
)
_NOSE = (
    *((0.5000, 0.3091), (0.5000, 0.3572), (0.5000, 0.4016), (0.5000, 0.4539)),
    *((0.4456, 0.5212), (0.4738, 0.5209), (0.5000, 0.5238), (0.5262, 0.5209), (0.5544, 0.5212)),
)
_EYES = (
    *((0.3064, 0.3225), (0.3320, 0.3033), (0.3793, 0.3007), (0.4200, 0.3304), (0.3815, 0.3376), (0.3326, 0.3382)),
    *((0.5800, 0.3304), (0.6207, 0.3007), (0.6680, 0.3033), (0.6936, 0.3225), (0.6674, 0.3382), (0.6185, 0.3376)),
)
_LIPS = (
    *((0.3900, 0.6243), (0.4261, 0.5921), (0.4684, 0.5767), (0.5000, 0.5793), (0.5316, 0.5767), (0.5739, 0.5921)),
    *((0.6100, 0.6243), (0.5782, 0.6476), (0.5449, 0.6583), (0.5000, 0.6615), (0.4551, 0.6583), (0.4218, 0.6476)),
    *((0.4041, 0.6230), (0.4568, 0.6146), (0.5000, 0.6158), (0.5432, 0.6146), (0.5959, 0.6230)),
    *((0.5464, 0.6182), (0.5000, 0.6191), (0.4536, 0.6182)),
)
TEMPLATE: FloatArray = np.array([*_JAW, *_BROWS, *_NOSE, *_EYES, *_LIPS])  # (68, 2)

# Eyes, nose tip and mouth corners in a picture of 112 pixels, the person's right first: `arcface_dst` of insightface's
# face_align.py (MIT), half a pixel added since its pixel centres are whole numbers.
ARCFACE_TEMPLATE: FloatArray = np.array(
    [(38.2946, 51.6963), (73.5318, 51.5014), (56.0252, 71.7366), (41.5493, 92.3655), (70.7299, 92.2041)]
) + np.array([0.5, 0.5])

_RIGHT_ANGLE = 1e-9  # of a crop's scale: so little turns no row
_ROUNDING_SHARE = 1e-9  # a spread or a scale below this share of the coordinates is rounding


def face_crop(landmarks: FloatArray, size: int) -> FloatArray:
    """(2, 3) matrix from crop pixels to image pixels that brings `landmarks` (68, 2) nearest to `TEMPLATE`.

    Least squares over turn, scale and shift, never a reflection; distances are measured in the crop.

    :param landmarks: pixels of the image
    :param size: pixels a side of the crop
    :raises InputError: another shape, NaN or infinity, landmarks at one place or nothing like a face's
    """
    return _crop(_checked(landmarks), TEMPLATE * size)


def arcface_crop(landmarks: FloatArray, size: int = ARCFACE_SIZE) -> FloatArray:
    """(2, 3) matrix from crop pixels to image pixels: the alignment of ArcFace by five points.

    The centres of the eyes, the tip of the nose and the corners of the mouth of `landmarks` (68, 2).

    Source: Deng et al., "ArcFace: Additive Angular Margin Loss for Deep Face Recognition", CVPR 2019; figures of
    insightface's `face_align.py`.

    :raises InputError: as `face_crop`
    """
    points = _checked(landmarks)
    eyes = points[36:42].mean(axis=0), points[42:48].mean(axis=0)
    return _crop(np.stack([*eyes, points[30], points[48], points[54]]), ARCFACE_TEMPLATE * (size / ARCFACE_SIZE))


def plain_crop(image: Float32Array, matrix: FloatArray, size: int) -> Float32Array:
    """(size, size, 3) the crop of an image (h, w, 3), bilinear, as `facepipe.networks.files` takes it with torch.

    :param matrix: (2, 3) from crop pixels to image pixels
    """
    factor = max(1, round(float(np.hypot(*matrix[:, 0]))))
    if factor == 1:
        return bilinear(image, matrix, size)
    # averaged where the crop lies alone, by whole pixels of the result: a photo has 12 million
    corners = from_crop(np.array([(0, 0), (size, 0), (0, size), (size, size)]), matrix)[:, ::-1]
    last = -(-np.array(image.shape[:2]) // factor) - 1
    first = np.clip(np.floor(corners.min(axis=0) / factor) - 1, 0, last).astype(np.int64)
    beyond = np.clip(np.ceil(corners.max(axis=0) / factor) + 1, first, last).astype(np.int64) + 1
    (top, left), (bottom, right) = first * factor, beyond * factor
    part = image[top:bottom, left:right]
    rows, columns = (np.arange(0, side, factor) for side in part.shape[:2])
    sums = np.add.reduceat(np.add.reduceat(part, rows, axis=0), columns, axis=1)
    height, width = part.shape[:2]
    counts = np.outer(np.minimum(height - rows, factor), np.minimum(width - columns, factor))
    within = matrix - np.column_stack([np.zeros((2, 2)), (left, top)])
    return bilinear((sums / counts[..., None]).astype(np.float32), within / factor, size)


def bilinear(image: Float32Array, matrix: FloatArray, size: int) -> Float32Array:
    """(size, size, c) the crop of an image (h, w, c); what lies outside has the colour of its nearest border pixel.

    scipy's `affine_transform` takes 3 times as long, and 8 times where rows and columns stay such, as in most crops
    of a search: those are mixed one axis after the other.

    :param matrix: (2, 3) from crop pixels to image pixels
    """
    pixels, centres = np.asarray(image, np.float32), np.arange(size) + 0.5
    (xx, xy, x), (yx, yy, y) = np.asarray(matrix)
    turned, along = max(abs(xx), abs(yy)), max(abs(xy), abs(yx))
    if min(turned, along) <= _RIGHT_ANGLE * max(turned, along):
        if along > turned:  # the image's columns are the crop's rows
            pixels, (xx, x, yy, y) = pixels.transpose(1, 0, 2), (yx, y, xy, x)
        for axis, (scale, start) in enumerate(((yy, y), (xx, x))):
            low, high, share = _between(scale * centres + start, pixels.shape[axis])
            share = share[:, None] if axis else share[:, None, None]
            near, far = pixels.take(low, axis), pixels.take(high, axis)
            pixels = near + share * (far - near)
        return np.ascontiguousarray(pixels)
    height, width, channels = pixels.shape
    left, right, across = _between(xx * centres + (xy * centres[:, None] + x), width)
    upper, lower, down = _between(yx * centres + (yy * centres[:, None] + y), height)
    flat, corners = np.ascontiguousarray(pixels).reshape(-1, channels), []
    for row in (upper * width, lower * width):
        near, far = flat.take(row + left, 0), flat.take(row + right, 0)
        corners.append(near + across[..., None] * (far - near))
    return np.asarray(corners[0] + down[..., None] * (corners[1] - corners[0]))


def _between(places: FloatArray, count: int) -> tuple[IntArray, IntArray, Float32Array]:
    """The pixels of a row before and after each place, and how near each is to the latter, 0 to 1."""
    places = np.clip(places - 0.5, 0, count - 1)
    before = places.astype(np.int64)
    return before, np.minimum(before + 1, count - 1), (places - before).astype(np.float32)


def turned_crop(matrix: FloatArray, turn: float, scale: float, size: int) -> FloatArray:
    """The crop turned and scaled about its centre.

    :param matrix: (2, 3) from crop pixels to image pixels
    """
    change = scale * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    centre = np.full(2, size / 2)
    linear = matrix[:, :2] @ change
    return np.column_stack([linear, matrix[:, :2] @ centre + matrix[:, 2] - linear @ centre])


def from_crop(points: FloatArray, matrix: FloatArray) -> FloatArray:
    """(..., 2) pixels of the image of crop pixels (..., 2)."""
    return np.asarray(np.asarray(points) @ matrix[:, :2].T + matrix[:, 2])


def to_crop(points: FloatArray, matrix: FloatArray) -> FloatArray:
    """(..., 2) crop pixels of pixels of the image (..., 2)."""
    return np.asarray((np.asarray(points) - matrix[:, 2]) @ np.linalg.inv(matrix[:, :2]).T)


def _crop(source: FloatArray, target: FloatArray) -> FloatArray:
    """The inverse of the similarity that brings `source` (n, 2) nearest to `target` (n, 2).

    In complex numbers a similarity is ``target = turn source + shift``, and least squares is one division.
    """
    from_points, to_points = source @ (1, 1j), target @ (1, 1j)
    spread = from_points - from_points.mean()
    size = np.vdot(spread, spread).real
    if size <= (_ROUNDING_SHARE * np.abs(source).max()) ** 2:
        raise InputError("landmarks", "all at one place, expected those of a face")
    turn = np.vdot(spread, to_points - to_points.mean()) / size
    if abs(turn) ** 2 * size <= (_ROUNDING_SHARE * np.abs(target).max()) ** 2:
        raise InputError("landmarks", "nothing like those of a face, expected the 68 of Multi-PIE in their order")
    back = 1 / turn
    shift = from_points.mean() - back * to_points.mean()
    return np.array([[back.real, -back.imag, shift.real], [back.imag, back.real, shift.imag]])


def _checked(landmarks: FloatArray) -> FloatArray:
    points = np.asarray(landmarks, dtype=np.float64)
    if points.shape != (68, 2):
        raise InputError("landmarks", f"an array of shape {points.shape}, expected (68, 2)")
    if not np.isfinite(points).all():
        raise InputError("landmarks", "NaN or infinity, expected finite numbers")
    return points
