"""Modes that come nearest to somebody, where they lie or with where the whole lies."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.similarity import Similarity, fit_similarity
from facepipe.payload.person import LARGEST_WEIGHT
from facepipe.rig.trs import quaternions

_RIDGE = 1e-9  # of each mode's square
_STEPS = 5  # in which modes and placement settle
WORTH = 0.8  # of what modes leave, below which more is worth its bytes


class ModeFit:
    """The least squares of a basis, whose matrix is the same for everyone.

    :param mean: (n, 3) points, millimetres
    :param modes: (k, n, 3)
    :param fitted: (m,) points that count
    """

    def __init__(self, mean: FloatArray, modes: FloatArray, fitted: IntArray) -> None:
        self._rows, self._mean = fitted, mean[fitted]
        self._modes = modes[:, fitted].reshape(len(modes), 3 * len(fitted)).astype(np.float64)
        self._squares = self._modes @ self._modes.T

    def nearest(self, points: FloatArray) -> FloatArray:
        """(k,) float16 weights of the modes that come nearest to points (n, 3) where these lie."""
        found = self._solved(points[self._rows], np.zeros((0, 3 * len(self._rows))))
        return np.clip(found, -LARGEST_WEIGHT, LARGEST_WEIGHT).astype(np.float16)

    def placed(self, points: FloatArray) -> tuple[FloatArray, FloatArray | None]:
        """(k,) float16 weights of the modes that come nearest to points (n, 3), and (7,) float32 where the whole lies
        if that is worth its bytes: blends and scans may stand anywhere.

        Modes move, turn and scale faces too: each step solves for them with the seven ways that a whole can go (Gauss
        and Newton), where modes and placement in turns are 0.1 mm off after 20.
        """
        own, count = points[self._rows], len(self._modes)

        def left(shown: FloatArray) -> float:
            return float(np.sqrt(((shown - own) ** 2).mean()))

        plain = self._solved(own, np.zeros((0, own.size)))
        weights: FloatArray = np.zeros(count)
        for _ in range(_STEPS if count else 1):
            shown = self._shaped(weights)
            weights = self._solved(fit_similarity(shown, own).undo(own), _ways(shown))
        shown = self._shaped(weights)
        found = fit_similarity(shown, own)
        worth = left(found.apply(shown)) < WORTH * left(self._shaped(plain))
        if not worth and np.abs(plain).max(initial=0.0) <= LARGEST_WEIGHT:
            return plain.astype(np.float16), None
        return weights.astype(np.float16), placement_of(found, np.zeros(3)).astype(np.float32)

    def _shaped(self, weights: FloatArray) -> FloatArray:
        return self._mean + (weights @ self._modes).reshape(-1, 3)

    def _solved(self, points: FloatArray, ways: FloatArray) -> FloatArray:
        """(k,) weights with which modes and ways (w, 3 m) come nearest to points (m, 3)."""
        to, across = (points - self._mean).ravel(), self._modes @ ways.T
        squares = np.block([[self._squares, across], [across.T, ways @ ways.T]])
        squares[np.diag_indices(len(squares))] += _RIDGE * squares.diagonal()
        right = np.concatenate([self._modes @ to, ways @ to])
        return np.asarray(np.linalg.solve(squares, right)[: len(self._modes)])


def placement_of(similarity: Similarity, about: FloatArray) -> FloatArray:
    """(7,) numbers of `PersonContent` for a similarity."""
    turn = quaternions(similarity.rotation)
    turn = turn * (1.0 if turn[3] >= 0 else -1.0)
    return np.concatenate([similarity.apply(about) - about, turn[:3], [np.log(similarity.scale)]])


def _ways(points: FloatArray) -> FloatArray:
    """(7, 3 m) how points (m, 3) go where a whole moves, turns and grows."""
    moves = np.repeat(np.eye(3)[:, None], len(points), axis=1)
    off = points - points.mean(axis=0)
    turns = [np.cross(axis, off) for axis in np.eye(3)]
    return np.array([*moves, *turns, off]).reshape(7, -1)
