"""The multilinear model of people's expressions: who it is and what the face does, taken apart.

The tensor of people x (neutral and expressions) x coordinates is taken apart by Tucker's decomposition: a core tensor,
an expression matrix with a row for the neutral, and a vector for each person (document face-model-from-scans, S14). Its
coordinates are of two kinds: those of the neutral in the principal components of neutrals, and those of deltas from the
neutral in a basis of their own. The mean over people is taken out first, so that a vector of zeros is the mean person.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import NamedTuple

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.names import unknown
from facepipe.geometry.identity_model import IdentityModel
from facepipe.geometry.shape_basis import coefficients_in

_NO_DIRECTION = 1e-7  # of the largest singular value: rounding to float32, no direction


@dataclass(frozen=True, kw_only=True)
class ExpressionModel:
    """``coordinates[e] = mean[e] + sum_rs vector_r matrix_es core_rs``; row 0 is the neutral, row 1 + i is `names[i]`.

    Vectors of the people that it was made of have mean 0 and variance 1 in each number.
    """

    names: tuple[str, ...]  # of the e expressions
    identity: IdentityModel  # its k components are what the neutral's coordinates are along, in the points' unit
    basis: FloatArray  # (q, n, 3) orthonormal, what the deltas' coordinates are along
    mean: FloatArray  # (e + 1, k + q)
    core: FloatArray  # (r, s, k + q)
    matrix: FloatArray  # (e + 1, s) expression matrix, orthonormal columns
    vectors: FloatArray  # (m, r) of its people

    @classmethod
    def from_people(
        cls,
        names: Sequence[str],
        identity: IdentityModel,
        neutrals: FloatArray,
        basis: FloatArray,
        deltas: FloatArray,
    ) -> ExpressionModel:
        """The model of m people.

        :param neutrals: (m, k) identity coefficients, in standard deviations
        :param deltas: (m, e, q) in `basis` (q, n, 3)
        """
        people, size = len(neutrals), len(identity.deviations)
        tensor = np.zeros((people, len(names) + 1, size + len(basis)))
        tensor[:, 0, :size] = neutrals * identity.deviations
        tensor[:, 1:, size:] = deltas
        mean = tensor.mean(axis=0)
        parts = hosvd(tensor - mean)
        # orthonormal columns have the variance 1 / (m - 1); scaled to 1, the prior of a new person is |v|^2
        spread = np.sqrt(max(people - 1, 1))
        return cls(
            names=tuple(names),
            identity=identity,
            basis=basis,
            mean=mean,
            core=parts.core / spread,
            matrix=parts.second,
            vectors=parts.first * spread,
        )

    @property
    def count(self) -> int:
        """People that it was made of."""
        return len(self.vectors)

    @property
    def deltas(self) -> FloatArray:
        """(m, e, q) of its people in `basis`."""
        size = len(self.identity.deviations)
        return np.asarray(self.mean[1:, size:] + np.tensordot(self.vectors, self._maps[:, 1:, size:], axes=1))

    def identity_from(
        self, shapes: Mapping[str, FloatArray], neutral: FloatArray, start: FloatArray | None = None
    ) -> FloatArray:
        """(r,) vector of the person who has `neutral` (n, 3) and whose expressions have the points `shapes` (n, 3).

        The most likely one, where vectors are as spread as those of the people here, and points are off by Gaussian
        noise. How much of it in the neutral and in the expressions is what best predicts the expressions of each
        person here from the others: a neutral that predicts little of its owner's smile counts little.

        :param start: (e, n, 3) deltas in the place of the mean person's, as for `shapes`
        :raises InputError: no expression of that name
        """
        rows = [0, *(1 + self._number(name) for name in shapes)]
        coordinates = np.zeros((len(rows), self.mean.shape[1]))
        size = len(self.identity.deviations)
        coordinates[0, :size] = self.identity.coefficients(neutral) * self.identity.deviations
        if shapes:
            # from the person's own neutral: what row 0 has already must not count again in each expression
            offsets = np.stack([np.asarray(points, np.float64) - neutral for points in shapes.values()])
            if start is not None:
                offsets -= start[[row - 1 for row in rows[1:]]]
            coordinates[1:, size:] = coefficients_in(self.basis, offsets)
        mean = self.mean[rows].copy()
        if start is not None:
            mean[1:] = 0.0
        off = coordinates - mean
        # (r,) vector of coordinates `off` (rows, k + q) from the mean's. The vector v has the prior N(0, 1), and group
        # g of rows (the neutral, the expressions) noise of inverse variance w_g: ``(1 + sum_g w_g M_g M_g^T) v = sum_g
        # w_g M_g off_g`` with the maps M. An expression that differs much between people is as much the less exact:
        # rows are divided by that spread first.
        spread = np.array([np.sqrt(np.square(self._flat([row])).sum()) for row in rows])
        shares = np.divide(1.0, spread, out=np.zeros(len(rows)), where=spread > 0)
        groups = [slice(0, 1), *([slice(1, None)] if len(rows) > 1 else [])]
        maps = [self._flat(rows[group], shares[group]) for group in groups]
        wanted = [row for row in range(1, len(self.mean)) if row not in rows] or list(range(1, len(self.mean)))
        *seen, expected = (self.vectors @ effects for effects in (*maps, self._flat(wanted)))
        weights = trust([numbers @ numbers.T for numbers in seen], expected @ expected.T)
        normal, right = np.eye(self.vectors.shape[1]), np.zeros(self.vectors.shape[1])
        for group, effects, weight in zip(groups, maps, weights, strict=True):
            normal += weight * effects @ effects.T
            right += weight * effects @ (shares[group, None] * off[group]).ravel()
        return np.asarray(np.linalg.solve(normal, right))

    def neutral(self, vector: FloatArray) -> FloatArray:
        """(n, 3) neutral of a vector (r,)."""
        size = len(self.identity.deviations)
        lengths = self.mean[0, :size] + np.tensordot(vector, self._maps[:, 0, :size], axes=1)
        return np.asarray(self.identity.mean + np.tensordot(lengths, self.identity.components, axes=1))

    def shapes(self, vector: FloatArray, start: FloatArray | None = None) -> FloatArray:
        """(e, n, 3) deltas of all expressions from the neutral, for a vector (r,), in the order of `names`.

        :param start: (e, n, 3) deltas in the place of the mean person's: what a vector of zeros gives, like the mean
            person's expressions fitted to the shape of another face
        """
        deltas = np.stack([self.shape(vector, name) for name in self.names])
        if start is not None:
            nobody = np.zeros(self.vectors.shape[1])
            for number, name in enumerate(self.names):
                deltas[number] += start[number] - self.shape(nobody, name)
        return deltas

    def shape(self, vector: FloatArray, name: str) -> FloatArray:
        """(n, 3) delta of one expression from the neutral, for a vector (r,).

        :raises InputError: no expression of that name
        """
        row, size = 1 + self._number(name), len(self.identity.deviations)
        lengths = self.mean[row, size:] + np.tensordot(vector, self._maps[:, row, size:], axes=1)
        return np.asarray(np.tensordot(lengths.astype(self.basis.dtype), self.basis, axes=1), dtype=np.float64)

    @cached_property
    def _maps(self) -> FloatArray:
        """(r, e + 1, k + q) what each number of a vector adds to each row."""
        return np.asarray(np.einsum("rsd,es->red", self.core, self.matrix, optimize=True))

    def _number(self, name: str) -> int:
        if name not in self.names:
            raise InputError("expression model", unknown(name, self.names, "expression"))
        return self.names.index(name)

    def _flat(self, rows: Sequence[int], shares: FloatArray | None = None) -> FloatArray:
        """(r, rows (k + q)) what each number of a vector adds to some rows, each times its share."""
        maps = self._maps[:, list(rows)]
        if shares is not None:
            maps = maps * shares[:, None]
        return maps.reshape(len(maps), len(rows) * maps.shape[2])


class Tucker(NamedTuple):
    """``tensor[i, j] = sum_ab first[i, a] second[j, b] core[a, b]``."""

    core: FloatArray  # (a, b, d)
    first: FloatArray  # (m, a), orthonormal columns, the strongest first
    second: FloatArray  # (s, b), orthonormal columns, the strongest first


def hosvd(tensor: FloatArray) -> Tucker:
    """Nothing but rounding is cut from a tensor (m, s, d); its third mode stays as it is.

    De Lathauwer, De Moor and Vandewalle, "A Multilinear Singular Value Decomposition", SIAM J. Matrix Anal. 2000.
    """
    values = np.asarray(tensor, dtype=np.float64)
    people, rows, size = values.shape
    first = _directions(values.reshape(people, rows * size))
    second = _directions(values.transpose(1, 0, 2).reshape(rows, people * size))
    core = np.einsum("ia,jb,ijd->abd", first, second, values, optimize=True)
    return Tucker(core, first, second)


def _directions(unfolded: FloatArray) -> FloatArray:
    """Left singular vectors as columns; the largest number of each is positive."""
    if not unfolded.size:
        return np.zeros((len(unfolded), 0))
    vectors, lengths, _ = np.linalg.svd(unfolded, full_matrices=False)
    vectors = vectors[:, lengths > _NO_DIRECTION * max(lengths[0], np.finfo(np.float64).tiny)]
    signs = np.sign(vectors[np.abs(vectors).argmax(axis=0), np.arange(vectors.shape[1])])
    return np.asarray(vectors * signs)


_TRUST_FACTORS = (0.0, *(10.0**power for power in np.arange(-2.0, 4.1, 0.5)))  # times the inverse of a mean square


def trust(seen: Sequence[FloatArray], wanted: FloatArray) -> list[float]:
    """The weight of each kind of numbers that is seen: the inverse of the variance of its noise.

    Those with which a Gaussian model of the other people comes nearest to what is wanted of each person, among powers
    of ten and 0; the smallest of those that do equally well. Leaving people out one by one has a closed form (Craven
    and Wahba, "Smoothing noisy data with spline functions", Numerische Mathematik 1978).

    :param seen: (m, m) inner products of m people's numbers, whose mean over people is 0
    :param wanted: (m, m) those of the numbers to predict
    """
    squares = [float(np.trace(products)) / len(products) for products in seen]
    scales = [1.0 / square if square > 0 else 0.0 for square in squares]
    best, chosen = np.inf, [0.0] * len(seen)
    if len(wanted) < 3:  # of two, each is predicted by the other alone, whatever the weights
        return chosen
    for steps in product(_TRUST_FACTORS, repeat=len(seen)):
        weights = [step * scale for step, scale in zip(steps, scales, strict=True)]
        summed = np.sum([weight * products for weight, products in zip(weights, seen, strict=True)], axis=0)
        missed = _missed(summed, wanted)
        if missed < best * (1.0 - 1e-9):
            best, chosen = missed, weights
    return chosen


def _missed(products: FloatArray, wanted: FloatArray) -> float:
    """Sum over people of the squared distance of what is predicted of them from what is so.

    Of m people with products K, all predicted at once are ``H y`` with ``H = (K' + 1)^-1 K' + 1/m``,
    ``K' = K / (m - 1)``; person i left out is missed by ``((1 - H) y)_i / (1 - H_ii)``, so that no person needs a solve
    of its own.
    """
    count = len(products)
    scaled = products / (count - 1)
    hat = np.linalg.solve(scaled + np.eye(count), scaled) + 1.0 / count
    left = np.eye(count) - hat
    return float((np.einsum("ij,jk,ik->i", left, wanted, left, optimize=True) / np.square(np.diag(left))).sum())
