"""Few shapes that frames of points are sums of."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from facepipe.core.arrays import FloatArray

_COLUMNS_AT_ONCE = 1 << 13
_ROTATION_POINTS = 1500  # points that the rotation is found by
_VARIMAX_ROUNDS = 100
_VARIMAX_GAIN = 1e-6  # of the criterion, a round
_NO_DIRECTION = 1e-12  # of the largest squared length: rounding, no direction
_NO_COEFFICIENT = 1e-6  # of the largest coefficients: float32, no direction


def motion_basis(deltas: FloatArray, tolerance: float, most: int) -> tuple[FloatArray, FloatArray]:
    """The fewest orthonormal shapes that leave at most `tolerance` of all frames (RMS over points), up to `most`.

    Principal components about rest, by the frames' Gram matrix, since frames are fewer than coordinates: of deltas D
    (f, 3n) with ``D D^T = V diag(s^2) V^T`` the shapes are ``V^T D / s``, and frames have ``V s`` of them. What the
    first r leave is the sum of the other s^2.

    :param deltas: (f, n, 3) from rest
    :param tolerance: in the unit of the deltas
    :returns: shapes (r, n, 3), and what frames have of them (f, r)
    """
    frames, points = len(deltas), deltas.shape[1]
    flat = np.asarray(deltas).reshape(frames, -1)
    values, vectors = np.linalg.eigh(sum((piece @ piece.T for piece in _pieces(flat)), np.zeros((frames, frames))))
    values, vectors = np.maximum(values[::-1], 0.0), vectors[:, ::-1]
    left = np.append(np.cumsum(values[::-1])[::-1], 0.0)  # squares that the first r leave
    enough = int(np.argmax(left <= tolerance**2 * frames * points))
    solid = int(np.count_nonzero(values > 1e-10 * values[0])) if frames else 0
    count = max(1, min(enough, most, solid))
    sizes = np.sqrt(np.maximum(values[:count], np.finfo(np.float64).tiny))
    shapes = np.concatenate([(vectors[:, :count] / sizes).T @ piece for piece in _pieces(flat)], axis=1)
    return shapes.reshape(count, points, 3), vectors[:, :count] * sizes


def _pieces(flat: FloatArray) -> Iterator[FloatArray]:
    """(f, some) columns as float64: all at once may be too much memory."""
    for start in range(0, flat.shape[1], _COLUMNS_AT_ONCE):
        yield flat[:, start : start + _COLUMNS_AT_ONCE].astype(np.float64)


def local_basis(shapes: FloatArray) -> FloatArray:
    """(r, n, 3) orthonormal shapes of the same space as orthonormal `shapes`, in fewer places where there are such.

    Turned so that what moves a point is one shape rather than all: varimax (Kaiser, "The varimax criterion for analytic
    rotation in factor analysis", 1958), by singular values (Magnus and Neudecker's fixed point).
    """
    count = len(shapes)
    if count < 2:
        return shapes
    moves = np.square(shapes).sum(axis=(0, 2))
    chosen = np.sort(np.argsort(-moves, kind="stable")[: 4 * _ROTATION_POINTS])
    # a quarter of the points that move most: for 100 shapes of 26,719 points all of them take 12 s instead of 0.8, and
    # leave the sum of lengths 1 % smaller
    rows = shapes[:, chosen[:: max(1, len(chosen) // _ROTATION_POINTS)]].reshape(count, -1).T
    rotation, least = np.eye(count), 0.0
    for _ in range(_VARIMAX_ROUNDS):
        turned = rows @ rotation
        left, sizes, right = np.linalg.svd(rows.T @ (turned**3 - turned * np.mean(turned**2, axis=0)))
        rotation = left @ right
        if sizes.sum() <= least * (1.0 + _VARIMAX_GAIN):
            break
        least = sizes.sum()
    local = np.tensordot(rotation.T, shapes, axes=1)
    return np.asarray(local if _spread(local) < _spread(shapes) else shapes)


def _spread(shapes: FloatArray) -> float:
    """The sum of all lengths: of shapes of unit length, larger sums spread over more points."""
    return float(np.linalg.norm(shapes, axis=2).sum())


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
    # (d, 3 n) orthonormal directions of `rest`, the strongest first; the largest number of each is positive
    values, vectors = np.linalg.eigh(rest @ rest.T)
    values, vectors = values[::-1], vectors[:, ::-1]
    kept = values > _NO_DIRECTION * max(float(values.max(initial=0.0)), np.finfo(np.float64).tiny)
    directions = (vectors[:, kept] / np.sqrt(values[kept])).T @ rest
    signs = np.sign(directions[np.arange(len(directions)), np.abs(directions).argmax(axis=1)])
    directions = np.asarray(directions * signs[:, None])
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
    in it: what they stand for stays, but for rounding."""
    size = coefficients.shape[-1]
    flat = np.asarray(coefficients, np.float64).reshape(-1, size)
    _, lengths, directions = np.linalg.svd(flat, full_matrices=False)
    kept = directions[lengths > _NO_COEFFICIENT * lengths.max(initial=0.0)]
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
