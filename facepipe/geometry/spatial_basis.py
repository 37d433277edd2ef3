"""A basis of deltas over the points of a face, grown until it holds each of them to a tolerance."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from facepipe.core.arrays import FloatArray

_NOTHING = 1e-12  # of the largest squared length: rounding, no direction
_ROUNDING = 1e-6  # of the largest coefficients: float32, no direction


class Held(NamedTuple):
    """Rows in a basis, and what it leaves of them."""

    basis: FloatArray  # (q, n, 3) float32, orthonormal as rows; the first ones are those that there were
    coefficients: FloatArray  # (e, q)
    distances: FloatArray  # (e, n) how far each point of each row is off


def no_basis(points: int) -> FloatArray:
    """(0, points, 3): holds nothing."""
    return np.zeros((0, points, 3), np.float32)


def hold(basis: FloatArray, rows: FloatArray, tolerance: float) -> Held:
    """`rows` (e, n, 3) in `basis` (q, n, 3), to which the fewest directions are added that this takes.

    They are the strongest of what is left of the rows; after them no row's points are off by more than `tolerance`,
    RMS. Sets of rows that come one after another give one basis, whether or not they come on one day.
    """
    count, points = rows.shape[:2]
    flat = basis.reshape(len(basis), 3 * points)
    coefficients, rest = _remainder(flat, np.asarray(rows, np.float64).reshape(count, 3 * points))
    directions = _strongest(rest)
    lengths = rest @ directions.T
    left = np.square(rest).sum(axis=1)[:, None] - np.cumsum(np.square(lengths), axis=1)  # after each direction
    left = np.concatenate([np.square(rest).sum(axis=1)[:, None], left], axis=1)
    enough = (left <= points * tolerance**2).all(axis=0)
    added = int(enough.argmax()) if enough.any() else len(directions)
    off = rest - lengths[:, :added] @ directions[:added]
    return Held(
        basis=np.concatenate([flat, directions[:added].astype(np.float32)]).reshape(-1, points, 3),
        coefficients=np.concatenate([coefficients, lengths[:, :added]], axis=1),
        distances=np.linalg.norm(off.reshape(count, points, 3), axis=2),
    )


def narrowed(basis: FloatArray, coefficients: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The basis (p, n, 3) of the directions that `coefficients` (..., q) in `basis` (q, n, 3) go, and those (..., p)
    in it: what is told stays, but for rounding."""
    size = coefficients.shape[-1]
    flat = np.asarray(coefficients, np.float64).reshape(-1, size)
    _, lengths, directions = np.linalg.svd(flat, full_matrices=False)
    kept = directions[lengths > _ROUNDING * lengths.max(initial=0.0)]
    if len(kept) == size:
        return basis, coefficients
    turned = (kept @ basis.reshape(size, -1)).astype(np.float32)
    return turned.reshape(len(kept), *basis.shape[1:]), coefficients @ kept.T


def coefficients_in(basis: FloatArray, rows: FloatArray) -> FloatArray:
    """(e, q) of the nearest rows that `basis` holds to `rows` (e, n, 3)."""
    size = 3 * basis.shape[1]
    return _remainder(basis.reshape(len(basis), size), np.asarray(rows, np.float64).reshape(len(rows), size))[0]


def _remainder(flat: FloatArray, rows: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Coefficients and what they leave; twice, as products are in float32."""
    coefficients, rest = np.zeros((len(rows), len(flat))), rows
    for _ in range(2):
        more = rest.astype(np.float32) @ flat.T
        coefficients, rest = coefficients + more, rest - more @ flat
    return coefficients, rest


def _strongest(rest: FloatArray) -> FloatArray:
    """(d, 3 n) orthonormal directions of `rest`, the strongest first; the largest number of each is positive."""
    values, vectors = np.linalg.eigh(rest @ rest.T)
    values, vectors = values[::-1], vectors[:, ::-1]
    kept = values > _NOTHING * max(float(values.max(initial=0.0)), np.finfo(np.float64).tiny)
    directions = (vectors[:, kept] / np.sqrt(values[kept])).T @ rest
    signs = np.sign(directions[np.arange(len(directions)), np.abs(directions).argmax(axis=1)])
    return np.asarray(directions * signs[:, None])
