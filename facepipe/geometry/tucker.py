"""The Tucker decomposition of a tensor of three modes, by singular vectors of two of them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from facepipe.core.arrays import FloatArray

_NOTHING = 1e-7  # of the largest singular value: rounding to float32, no direction


class Tucker(NamedTuple):
    """``tensor[i, j] = sum_ab first[i, a] second[j, b] core[a, b]``."""

    core: FloatArray  # (a, b, d)
    first: FloatArray  # (m, a), orthonormal columns, the strongest first
    second: FloatArray  # (s, b), orthonormal columns, the strongest first


def hosvd(tensor: FloatArray) -> Tucker:
    """Nothing but rounding is cut from a tensor (m, s, d); its third mode stays as it is.

    De Lathauwer, De Moor and Vandewalle, "A Multilinear Singular Value Decomposition", SIAM J. Matrix Anal. 2000.
    """
    found = np.asarray(tensor, dtype=np.float64)
    people, rows, size = found.shape
    first = _directions(found.reshape(people, rows * size))
    second = _directions(found.transpose(1, 0, 2).reshape(rows, people * size))
    core = np.einsum("ia,jb,ijd->abd", first, second, found, optimize=True)
    return Tucker(core, first, second)


def _directions(unfolded: FloatArray) -> FloatArray:
    """Left singular vectors as columns; the largest number of each is positive."""
    if not unfolded.size:
        return np.zeros((len(unfolded), 0))
    vectors, lengths, _ = np.linalg.svd(unfolded, full_matrices=False)
    vectors = vectors[:, lengths > _NOTHING * max(lengths[0], np.finfo(np.float64).tiny)]
    signs = np.sign(vectors[np.abs(vectors).argmax(axis=0), np.arange(vectors.shape[1])])
    return np.asarray(vectors * signs)
