"""Modes that come nearest to somebody, where they lie or with where the whole lies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.similarity import Similarity, fit_similarity
from facepipe.payload.person import LARGEST_WEIGHT
from facepipe.rig.trs import quaternions

_RIDGE = 1e-9  # of each mode's square
_ROUNDING = 1e-10  # of squares of points, of their sums
_STEPS = 5  # in which modes and placement settle
WORTH = 0.8  # of what modes leave, below which more is worth its bytes


class ModeFit:
    """The least squares of a basis, whose matrix is the same for everyone.

    Of a face a fit takes sums over its points alone, by axes of modes: one pass over the modes, where each step on
    points takes two. Sums of modes with each other are known before.

    :param mean: (n, 3) points, millimetres
    :param modes: (k, n, 3)
    :param fitted: (m,) points that count
    """

    def __init__(self, mean: FloatArray, modes: FloatArray, fitted: IntArray) -> None:
        count = len(modes)
        self._rows, self._centre = fitted, mean[fitted].mean(axis=0)
        self._mean = mean[fitted] - self._centre
        axes = modes[:, fitted].astype(np.float64).transpose(0, 2, 1)
        self._axes = np.ascontiguousarray(axes).reshape(3 * count, len(fitted))
        self._sums = self._axes.sum(axis=1).reshape(count, 3)
        self._with_mean = self._with(self._mean)
        self._with_modes = (self._axes @ self._axes.T).reshape(count, 3, count, 3)
        self._squares = np.trace(self._with_modes, axis1=1, axis2=3)
        self._squares[np.diag_indices(count)] *= 1 + _RIDGE

    def nearest(self, points: FloatArray) -> FloatArray:
        """(k,) float16 weights of the modes that come nearest to points (n, 3) where these lie."""
        right = _traces(self._with(points[self._rows] - self._centre) - self._with_mean)
        found = np.linalg.solve(self._squares, right)
        return np.clip(found, -LARGEST_WEIGHT, LARGEST_WEIGHT).astype(np.float16)

    def placed(self, points: FloatArray) -> tuple[FloatArray, FloatArray | None]:
        """(k,) float16 weights of the modes that come nearest to points (n, 3), and (7,) float32 where the whole lies
        if that is worth its bytes: blends and scans may stand anywhere.

        Modes move, turn and scale faces too: each step solves for them with the seven ways that a whole can go (Gauss
        and Newton), where modes and placement in turns are 0.1 mm off after 20.
        """
        own = points[self._rows] - self._centre
        known, middle, count = self._with(own), own.mean(axis=0), len(self._sums)
        right = _traces(known - self._with_mean)
        plain = np.linalg.solve(self._squares, right)
        left = ((own - self._mean) ** 2).sum() - 2 * plain @ right + plain @ self._squares @ plain
        of_modes, of_mean = known - self._sums[:, :, None] * middle, self._mean.T @ (own - middle)
        weights: FloatArray = np.zeros(count)
        shown = self._shown(weights, of_modes, of_mean)
        for _ in range(_STEPS if count else 0):
            weights = self._stepped(shown, of_modes)
            shown = self._shown(weights, of_modes, of_mean)
        squares = ((own - middle) ** 2).sum()
        worth = squares - shown.strength * shown.scale < WORTH**2 * left - _ROUNDING * squares
        if not worth and np.abs(plain).max(initial=0.0) <= LARGEST_WEIGHT:
            return plain.astype(np.float16), None
        moves = weights @ self._axes.reshape(count, 3 * len(own))
        found = fit_similarity(self._centre + self._mean + moves.reshape(3, len(own)).T, points[self._rows])
        return weights.astype(np.float16), placement_of(found, np.zeros(3)).astype(np.float32)

    def _with(self, points: FloatArray) -> FloatArray:
        """(k, 3, 3) sums over points (m, 3) of each axis of modes times each of theirs."""
        return np.asarray(self._axes @ points).reshape(len(self._sums), 3, 3)

    def _shown(self, weights: FloatArray, of_modes: FloatArray, of_mean: FloatArray) -> _Shown:
        """Sums of the points of weights (k,), and the similarity from these to a face.

        :param of_modes: (k, 3, 3) of modes with the face's points about their middle
        :param of_mean: (3, 3) of the mean with these
        """
        by_modes, by_mean = np.tensordot(self._with_modes, weights, (2, 0)), np.tensordot(weights, self._with_mean, 1)
        middle = weights @ self._sums / len(self._mean)
        square = self._mean.T @ self._mean + np.tensordot(weights, by_modes, 1) + by_mean + by_mean.T
        square -= len(self._mean) * np.outer(middle, middle)
        across = of_mean + np.tensordot(weights, of_modes, 1)
        # Umeyama, "Least-squares estimation of transformation parameters between two point patterns", IEEE TPAMI 1991
        U, D, Vt = np.linalg.svd(across.T)
        signs = np.array([1.0, 1.0, -1.0 if np.linalg.det(U) * np.linalg.det(Vt) < 0 else 1.0])
        strength, spread = float(D @ signs), max(float(np.trace(square)), np.finfo(np.float64).tiny)
        return _Shown(
            with_modes=self._with_mean + by_modes - self._sums[:, :, None] * middle,
            with_mean=self._mean.T @ self._mean + by_mean,
            square=square,
            middle=middle,
            across=across,
            rotation=(U * signs) @ Vt,
            scale=strength / spread if strength > _ROUNDING * spread else 1.0,  # of a face that is one point
            strength=strength,
        )

    def _stepped(self, shown: _Shown, of_modes: FloatArray) -> FloatArray:
        """(k,) weights with which modes and ways come nearest to the face, moved back to what is shown.

        The seven ways: it moves, turns about its middle, and grows.
        """
        count = len(self._mean)
        across = np.hstack([self._sums, _turns(shown.with_modes), _traces(shown.with_modes)[:, None]])
        ways = np.zeros((7, 7))
        ways[:3, :3] = count * np.eye(3)
        ways[3:6, 3:6] = np.trace(shown.square) * np.eye(3) - shown.square
        ways[6, 6] = np.trace(shown.square)
        ways[np.diag_indices(7)] *= 1 + _RIDGE
        # the face moved back is  own rotation / scale + middle , and what is wanted that less the mean
        back = shown.rotation / shown.scale
        wanted = shown.across @ back - shown.with_mean
        right = np.einsum("kab,ba->k", of_modes, back) + self._sums @ shown.middle - _traces(self._with_mean)
        of_ways = [count * shown.middle, -_turns(wanted[None])[0], [np.trace(wanted)]]
        squares = np.block([[self._squares, across], [across.T, ways]])
        return np.asarray(np.linalg.solve(squares, np.concatenate([right, *of_ways]))[: len(self._sums)])


@dataclass(frozen=True, kw_only=True)
class _Shown:
    """Sums over the points that weights of modes show, about their middle."""

    with_modes: FloatArray  # (k, 3, 3)
    with_mean: FloatArray  # (3, 3)
    square: FloatArray  # (3, 3) with themselves
    across: FloatArray  # (3, 3) with the face's
    middle: FloatArray  # (3,) of them
    rotation: FloatArray  # (3, 3) to the face
    scale: float
    strength: float  # what the scale is of the spread


def _traces(sums: FloatArray) -> FloatArray:
    """(k,) of (k, 3, 3): products of vectors."""
    return np.asarray(np.trace(sums, axis1=1, axis2=2))


def _turns(sums: FloatArray) -> FloatArray:
    """(k, 3) of (k, 3, 3), of vectors a and b: what a is along  axis x b , for each axis."""
    return np.stack([sums[:, i - 1, i - 2] - sums[:, i - 2, i - 1] for i in range(3)], axis=1)


def placement_of(similarity: Similarity, about: FloatArray) -> FloatArray:
    """(7,) numbers of `PersonContent` for a similarity."""
    turn = quaternions(similarity.rotation)
    turn = turn * (1.0 if turn[3] >= 0 else -1.0)
    return np.concatenate([similarity.apply(about) - about, turn[:3], [np.log(similarity.scale)]])
