"""The measure of landmark errors: how far apart the eyes are."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray

OUTER_CORNERS = (36, 45)  # of the eyes, in the Multi-PIE scheme


def eye_distance(landmarks: FloatArray) -> float:
    """Distance of the outer corners of the eyes of (68, 2) landmarks, in their units.

    What errors are normalised by since Sagonas et al., "300 Faces in-the-Wild Challenge", ICCV workshops 2013.
    """
    one, other = np.asarray(landmarks, dtype=np.float64)[list(OUTER_CORNERS)]
    return float(np.linalg.norm(one - other))
