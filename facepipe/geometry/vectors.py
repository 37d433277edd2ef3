"""Directions of vectors."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray


def unit_vectors(vectors: FloatArray) -> FloatArray:
    """(v, c) of length 1; those of length 0 stay."""
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.where(lengths > 0, lengths, 1.0))
