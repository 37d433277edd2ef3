"""Measures of landmarks: how far apart the eyes are, which way is down, whether left and right are changed over."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.geometry.similarity import fit_similarity

OUTER_CORNERS = (36, 45)  # of the eyes, in the Multi-PIE scheme
# The landmark of the other side for each of the 68.
MIRRORED = [
    *range(16, -1, -1),
    *range(26, 16, -1),
    *range(27, 31),
    *range(35, 30, -1),
    *(45, 44, 43, 42, 47, 46, 39, 38, 37, 36, 41, 40),
    *(54, 53, 52, 51, 50, 49, 48, 59, 58, 57, 56, 55),
    *(64, 63, 62, 61, 60, 67, 66, 65),
]
_UPPER = [*range(17, 28), *range(36, 48)]  # brows, eyes and the bridge of the nose
_HEIGHT = 0.7  # of the length of `downward`: a third less than the eye distance of the average head from the front
_LOWER = [*range(5, 12), *range(48, 68)]  # chin and mouth


def eye_distance(landmarks: FloatArray) -> float:
    """Distance of the outer corners of the eyes of (68, 2) landmarks, in their units.

    What errors are normalised by since Sagonas et al., "300 Faces in-the-Wild Challenge", ICCV workshops 2013.
    """
    one, other = np.asarray(landmarks, dtype=np.float64)[list(OUTER_CORNERS)]
    return float(np.linalg.norm(one - other))


def downward(landmarks: FloatArray) -> FloatArray:
    """(2,) from the middle of brows and eyes to that of mouth and chin, of (68, 2) landmarks, in their units."""
    return np.asarray(landmarks[_LOWER].mean(axis=0) - landmarks[_UPPER].mean(axis=0))


def face_size(landmarks: FloatArray) -> float:
    """What errors of landmarks (68, 2) are relative to: `eye_distance`, or more by the face's height where a head is
    turned so far that the eyes are close together."""
    return max(eye_distance(landmarks), _HEIGHT * float(np.linalg.norm(downward(landmarks))))


def quarters_to_upright(landmarks: FloatArray) -> int:
    """Quarter turns by `numpy.rot90` after which a picture shows the face with (68, 2) landmarks within 45 degrees of
    upright, 0 to 3; landmarks with y down."""
    right, down = downward(landmarks)
    return round(float(np.arctan2(-right, down)) / (np.pi / 2)) % 4


def quarter_turned(places: FloatArray, quarters: int, size: tuple[float, float]) -> FloatArray:
    """Places (..., 2) of a picture once it is turned by `numpy.rot90`; x right, y down from its top left corner.

    :param quarters: any whole number
    :param size: width and height of the picture before
    """
    width, height = size
    x, y = places[..., 0], places[..., 1]
    turned = ((x, y), (y, width - x), (width - x, height - y), (height - y, x))
    return np.stack(turned[quarters % 4], axis=-1)


def turned_view(places: FloatArray, pixels: FloatArray, weights: FloatArray | None = None) -> FloatArray:
    """(2, 3) the scaled rotation that shows places (n, 3) next to pixels (n, 2), each about its own mean.

    The affine camera in least squares, a picture from far away, brought to right angles.

    :param weights: (n,) of squared errors; None: all alike
    """
    weights = np.ones(len(pixels)) if weights is None else weights
    rows, seen = (
        np.sqrt(weights)[:, None] * (marks - np.average(marks, axis=0, weights=weights)) for marks in (places, pixels)
    )
    affine = np.linalg.lstsq(rows, seen, rcond=None)[0].T
    left, scales, right = np.linalg.svd(affine, full_matrices=False)
    return np.asarray(scales.mean() * left @ right)


def mirrored(points: FloatArray, reference: FloatArray) -> bool:
    """Whether `points` fit `reference` far better mirrored than as they are: see `mirror_ratio`.

    A face is nearly its own mirror image, but landmarks have an order: those of a mirrored file have left and right
    changed over. Two people (ICT identities, open jaws, 1.5 mm of jitter) have ratios below 0.4, and above 2.5 where
    one is mirrored; 1.5 is the border. Few landmarks decide less: of ten, true ratios reach 1.1, and mirrored ones may
    pass.

    :param points: (l, 3) landmarks in any unit and place, rows of NaN where unknown
    :param reference: (l, 3) the same landmarks of some face; of both 4 at least are known: fewer lie in a plane
    """
    return mirror_ratio(points, reference) > 1.5


def mirror_ratio(points: FloatArray, reference: FloatArray) -> float:
    """RMS distance after the best similarity, over that of the best one with a reflection (Umeyama 1991, eq. 43).

    1 where all lie in a plane.
    """
    known = np.isfinite(points).all(axis=1) & np.isfinite(reference).all(axis=1)
    plain = _distance(np.asarray(points)[known], np.asarray(reference)[known])
    turned = _distance(np.asarray(points)[known] * [-1.0, 1.0, 1.0], np.asarray(reference)[known])
    least = 1e-9 * float(np.ptp(np.asarray(reference)[known], axis=0).max())
    return max(plain, least) / max(turned, least)


def _distance(points: FloatArray, reference: FloatArray) -> float:
    offsets = fit_similarity(points, reference).apply(points) - reference
    return float(np.sqrt((offsets**2).sum(axis=1).mean()))
