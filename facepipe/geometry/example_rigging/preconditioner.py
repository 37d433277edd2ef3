"""An approximate inverse of the system of fields and weights: each shape's own fields, and the shared ones, by
themselves."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.geometry.example_rigging.field_system import FieldSystem, crossed


class Preconditioner:
    """Cholesky factors of the diagonal blocks.

    :param weights: (c, e)
    :param diagonal: (w,) of the matrix at the changes of weights
    """

    def __init__(self, system: FieldSystem, weights: FloatArray, diagonal: FloatArray) -> None:
        from scipy.linalg import cho_factor

        self._starts, self._diagonal = system.starts, diagonal
        self._factors = []
        for row in system.rows:
            told = (weights[:, row.shape] ** 2) @ system.trust[:, row.points]
            products = told[:, None, None] * _products(row.template)
            self._factors.append(cho_factor(_block(row.values, products, system.own_spread), lower=True))
        shared = _block(system.shared_values, _shared_products(system, weights), system.shared_spread)
        self._factors.append(cho_factor(shared, lower=True))

    def solve(self, right: FloatArray) -> FloatArray:
        """(z + w,) about the system's solution."""
        from scipy.linalg import cho_solve

        right = right.ravel()
        parts = [
            cho_solve(factor, right[self._starts[part] : self._starts[part + 1]], check_finite=False)
            for part, factor in enumerate(self._factors)
        ]
        return np.concatenate([*parts, right[self._starts[-1] :] / self._diagonal])


def _products(delta: FloatArray) -> FloatArray:
    """(p, 4, 4) J^T J of the motion that gain and turn make of deltas (p, 3)."""
    columns = _columns(delta)
    return np.asarray(columns.transpose(0, 2, 1) @ columns)


def _columns(delta: FloatArray) -> FloatArray:
    """(p, 3, 4)"""
    axes = [crossed(np.broadcast_to(axis, delta.shape), delta) for axis in np.eye(3)]
    return np.stack([delta, *axes], axis=2)


def _shared_products(system: FieldSystem, weights: FloatArray) -> FloatArray:
    """(s, 4, 4) of the composites that templates make."""
    total = np.zeros((len(system.sample), 4, 4))
    for weight, trust in zip(weights, system.trust, strict=True):
        made = np.tensordot(weight, system.examples.templates[:, system.sample], axes=1)
        total += trust[:, None, None] * _products(made)
    return total


def _block(values: FloatArray, products: FloatArray, spread: FloatArray) -> FloatArray:
    """(4k, 4k) the identity and what the points (p) tell, with basis values (p, k) and products (p, 4, 4)."""
    size = values.shape[1]
    block = np.eye(4 * size)
    for a in range(4):
        for b in range(a, 4):
            weight = products[:, a, b] * spread[a] * spread[b]
            if not weight.any():
                continue
            part = values.T @ (weight[:, None] * values)
            block[a * size : (a + 1) * size, b * size : (b + 1) * size] += part
            if a != b:
                block[b * size : (b + 1) * size, a * size : (a + 1) * size] += part
    return block
