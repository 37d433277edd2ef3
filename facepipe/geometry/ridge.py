"""Ridge regression: straight maps from noisy numbers, learned of few examples.

Least squares with Gaussian noise on the inputs is ridge regression (Bishop, "Training with Noise is Equivalent to
Tikhonov Regularization", Neural Computation 1995): ``min |A x - b|^2 + noise^2 |x|^2``. Where points of a
surface follow few inputs, each input has its own strength at each point, and counts there as far as it stands out of
the noise: what hardly moves a point is not taken as the cause of what is seen at it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray

_FOLDS = 5  # of the examples, each left out once
_NOISE_POINTS = 400  # points that the noise is chosen at
_POINTS_AT_ONCE = 256  # points at a time


def ridge(seen: FloatArray, wanted: FloatArray, noise: float | FloatArray) -> tuple[FloatArray, FloatArray]:
    """(s, t) and (t,): the map and offset of least squared error from rows of `seen`, each with other noise, to
    `wanted`.

    ``(A^T A + n diag(noise^2)) M = A^T B`` with rows A and B less their means: the expected error of a map M gains
    ``|noise M|^2`` a row. Source: Hoerl and Kennard, Ridge regression (1970).

    :param seen: (n, s)
    :param wanted: (n, t)
    :param noise: standard deviation of the numbers seen, above 0: of all, or of each (s,)
    """
    middle, mean = seen.mean(axis=0), wanted.mean(axis=0)
    from_middle = np.asarray(seen - middle, np.float64)
    normal = from_middle.T @ from_middle
    normal[np.diag_indices_from(normal)] += len(seen) * noise**2
    found = np.linalg.solve(normal, from_middle.T @ wanted)  # of whose mean nothing is left
    return found, mean - middle @ found


@dataclass(frozen=True, kw_only=True)
class PointMaps:
    """``x by_input[:, i] + vector_i by_vector[i]``: what point i is moved."""

    by_input: FloatArray  # (c, n, 3)
    by_vector: FloatArray  # (n, 3, 3)

    def __call__(self, inputs: FloatArray, vectors: FloatArray) -> FloatArray:
        """(f, n, 3) of inputs (f, c) and the points' own vectors (f, n, 3)."""
        return np.asarray(
            np.tensordot(inputs, self.by_input, axes=1) + np.einsum("fni,nij->fnj", vectors, self.by_vector)
        )


@dataclass(frozen=True, kw_only=True)
class Examples:
    """f examples of c inputs, a vector of each point's own, and where the points went beyond what was expected."""

    inputs: FloatArray  # (f, c)
    vectors: FloatArray  # (f, n, 3) of the points' own
    strengths: FloatArray  # (c, n) how far a unit of each input is expected to move each point
    moved: FloatArray  # (f, n, 3)

    def maps(self, noise: float) -> PointMaps:
        """The maps of least squares with noise on inputs; where examples are silent, nothing is moved.

        At point i, of examples A in inputs of strengths S and P in the point's own vector, with motions Y:
        ``D = (A S^2 A^T + P P^T + noise^2)^-1 Y``, then ``by_input = S^2 A^T D`` and ``by_vector = P^T D``. In this
        dual form a system is as large as there are examples, which are few.

        :param noise: of examples, in shares of `strengths` and in the unit of the points: both scale alike
        """
        by_input = np.empty((self.inputs.shape[1], *self.moved.shape[1:]))
        by_vector = np.empty((self.moved.shape[1], 3, 3))
        everything = np.arange(len(self.inputs))
        for points in _chunks(self.moved.shape[1]):
            duals = self._solved(self._products(everything, everything, points), everything, points, noise)
            scaled = np.einsum("fc,nfi->cni", self.inputs, duals)
            by_input[:, points] = scaled * self.strengths[:, points, None] ** 2
            by_vector[points] = np.einsum("fni,nfj->nij", self.vectors[:, points], duals)
        return PointMaps(by_input=by_input, by_vector=by_vector)

    def normal(self, slopes: FloatArray, noise: float) -> tuple[FloatArray, FloatArray]:
        """Normal equations of all points for unknowns that they share, where each also has maps of its own.

        Generalised least squares of ``moved + slopes unknowns``: the covariance of a point's examples is that of its
        maps and of the noise (Rasmussen and Williams, "Gaussian Processes for Machine Learning", 2006, section 2.7).

        :param slopes: (f, k, n, 3) how the examples' points answer to k unknowns
        :param noise: as of `maps`
        :returns: (k, k) second and (k,) first derivatives of half the squares, in squares of the noise, a point
        """
        unknowns, count = slopes.shape[1], self.moved.shape[1]
        matrix, off = np.zeros((unknowns, unknowns)), np.zeros(unknowns)
        everything = np.arange(len(self.inputs))
        for points in _chunks(count):
            products = self._products(everything, everything, points) + noise**2 * np.eye(len(everything))
            by_unknown = slopes[:, :, points].transpose(2, 0, 1, 3).reshape(len(points), len(everything), -1)
            both = np.concatenate([by_unknown, self.moved[:, points].transpose(1, 0, 2)], axis=2)
            # covariance L L^T: products of L^-1 slopes and L^-1 moved are those of least squares weighed by its inverse
            weighed = np.linalg.solve(np.linalg.cholesky(products), both)
            parts = weighed.reshape(len(points), len(everything), unknowns + 1, 3).transpose(2, 0, 1, 3)
            flat = parts.reshape(unknowns + 1, -1)
            matrix += flat[:-1] @ flat[:-1].T / count
            off += flat[:-1] @ flat[-1] / count
        return matrix, off

    def best_noise(self, noises: FloatArray) -> float:
        """The noise of least mean distance where a fifth of the examples in a row is left out, then the next."""
        points = np.arange(0, self.moved.shape[1], max(1, self.moved.shape[1] // _NOISE_POINTS))
        parts = np.array_split(np.arange(len(self.inputs)), min(_FOLDS, len(self.inputs)))
        return float(noises[int(np.argmin(sum(self._missed(part, points, noises) for part in parts)))])

    def _missed(self, left_out: IntArray, points: IntArray, noises: FloatArray) -> FloatArray:
        """(noises,) sums of distances, at left-out examples, from what the others predict with each noise."""
        kept = np.setdiff1d(np.arange(len(self.inputs)), left_out)
        products, across = self._products(kept, kept, points), self._products(left_out, kept, points)
        moved = self.moved[left_out][:, points].transpose(1, 0, 2)
        predicted = (across @ self._solved(products, kept, points, noise) for noise in noises)
        return np.array([np.linalg.norm(guess - moved, axis=2).sum() for guess in predicted])

    def _solved(self, products: FloatArray, examples: IntArray, points: IntArray, noise: float) -> FloatArray:
        """(p, f, 3) solutions of the points' own systems (p, f, f), which come without their noise."""
        noisy = products + noise**2 * np.eye(len(examples))
        return np.asarray(np.linalg.solve(noisy, self.moved[examples][:, points].transpose(1, 0, 2)))

    def _products(self, rows: IntArray, columns: IntArray, points: IntArray) -> FloatArray:
        """(p, f, g) inner products of examples at each point."""
        squares = self.strengths[:, points].T ** 2
        products = (self.inputs[rows][None] * squares[:, None]) @ self.inputs[columns].T
        vectors = self.vectors[:, points].transpose(1, 0, 2)
        return np.asarray(products + vectors[:, rows] @ vectors[:, columns].transpose(0, 2, 1))


def _chunks(count: int) -> Iterator[IntArray]:
    for start in range(0, count, _POINTS_AT_ONCE):
        yield np.arange(start, min(start + _POINTS_AT_ONCE, count))
