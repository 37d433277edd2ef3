"""Measures of landmarks: how far apart the eyes are, and whether left and right are changed over."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.geometry.similarity import fit_similarity

OUTER_CORNERS = (36, 45)  # of the eyes, in the Multi-PIE scheme


def eye_distance(landmarks: FloatArray) -> float:
    """Distance of the outer corners of the eyes of (68, 2) landmarks, in their units.

    What errors are normalised by since Sagonas et al., "300 Faces in-the-Wild Challenge", ICCV workshops 2013.
    """
    one, other = np.asarray(landmarks, dtype=np.float64)[list(OUTER_CORNERS)]
    return float(np.linalg.norm(one - other))


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
