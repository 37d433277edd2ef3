"""Gains, turns and weights together: Gauss-Newton steps on the composites, by conjugate gradients."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.example_rigging.field_system import FieldSystem, bent, bent_back, crossed
from facepipe.geometry.example_rigging.options import SplitOptions

_CG_TOLERANCE = 1e-4  # of the right-hand side that conjugate gradients leave
_CG_STEPS = 400


@dataclass(frozen=True)
class FieldSolution:
    """The person's fields and the weights that explain the composites best."""

    z: FloatArray  # unknowns of `FieldSystem`
    weights: FloatArray  # (c, e)
    held: tuple[tuple[int, int], ...] = ()  # (composite, shape) of weights stopped at a bound
    settled: bool = True  # conjugate gradients came to their end


def solve_fields(system: FieldSystem, options: SplitOptions) -> FieldSolution:
    """The most probable fields, and weights inside their bounds.

    Each alternation solves for the fields with the last weights and, together with them, for the change of weights
    that the templates show. A weight that goes beyond its bound is held there from then on. The last solve is for the
    fields alone.
    """
    given_weights = system.examples.weights
    low, high = np.minimum(given_weights, 0.0), np.maximum(given_weights, options.largest_weight)
    weights, z, held = given_weights.copy(), np.zeros(system.starts[-1]), given_weights == 0
    for _ in range(options.alternations if options.weight_spread > 0 else 0):
        # Li, Weise & Pauly (SIGGRAPH 2010, section 4) solve for fields and weights in turn; but where shapes follow the
        # scans, nothing is left by which weights could move. By personal shapes in place of the templates weights would
        # grow: that makes all of the fields smaller
        step = _Step(system, weights, z, np.where(held, 0.0, options.weight_spread)).solve()
        ahead = weights + step.change
        z, weights = step.z, np.clip(ahead, low, high)
        held = held | (ahead != weights)
    last = _Step(system, weights, z, np.zeros_like(weights)).solve()
    stopped = tuple((int(composite), int(shape)) for composite, shape in np.argwhere(held & (given_weights != 0)))
    return FieldSolution(last.z, weights, stopped, last.settled)


class _Found(NamedTuple):
    z: FloatArray
    change: FloatArray  # (c, e) of the weights
    settled: bool


class _Step:
    """One linear problem: fields and changes of weights x, each of spread 1 a priori, from what is left of composites.

    Minimises ``|x - m|^2 + sum trust |left - P x|^2``: ``(1 + P^T C P) x = P^T C left + m``, where P makes composites
    of the unknowns, C is the diagonal of trust, and m how far given weights are from where this step starts. P is
    applied shape by shape; its product with itself would be dense.

    :param weights: (c, e) from where weights change
    :param z: fields to start from
    :param spreads: (c, e) of the weights; 0 keeps one
    """

    def __init__(self, system: FieldSystem, weights: FloatArray, z: FloatArray, spreads: FloatArray) -> None:
        self._system, self._weights, self._z = system, weights, z
        shapes = [row.shape for row in system.rows]
        self._uses: list[IntArray] = [np.flatnonzero(system.examples.weights[:, shape]) for shape in shapes]
        self._moving: list[IntArray] = [
            composites[spreads[composites, shape] > 0] for composites, shape in self._pairs(self._uses)
        ]
        self._spread = spreads
        self._changes = np.cumsum([system.starts[-1], *[len(composites) for composites in self._moving]])

    def _pairs(self, uses: list[IntArray]) -> list[tuple[IntArray, int]]:
        return [(composites, row.shape) for composites, row in zip(uses, self._system.rows, strict=True)]

    def solve(self) -> _Found:
        from scipy.sparse.linalg import LinearOperator, cg

        system, size = self._system, int(self._changes[-1])
        given_weights = system.examples.weights
        offsets = system.examples.offsets[:, system.sample]
        left = offsets - np.tensordot(self._weights, system.examples.templates[:, system.sample], axes=1)
        right = self._pulled(system.trust[:, :, None] * left)
        start = np.zeros(size)
        start[: len(self._z)] = self._z
        for number, (composites, shape) in enumerate(self._pairs(self._moving)):
            spread = self._spread[composites, shape]
            # the prior holds weights to the given ones: held to those of the last step they would drift
            behind = (given_weights[composites, shape] - self._weights[composites, shape]) / spread
            right[self._changes[number] : self._changes[number + 1]] += behind
        if not right.any():
            return _Found(np.zeros(system.starts[-1]), np.zeros_like(given_weights), True)
        matrix = LinearOperator((size, size), matvec=self._applied, dtype=np.float64)
        guess = Preconditioner(system, self._weights, self._weight_diagonal())
        inverse = LinearOperator((size, size), matvec=guess.solve, dtype=np.float64)
        unknowns, steps = cg(matrix, right, x0=start, rtol=_CG_TOLERANCE, maxiter=_CG_STEPS, M=inverse)
        change = np.zeros_like(given_weights)
        for number, (composites, shape) in enumerate(self._pairs(self._moving)):
            scaled = unknowns[self._changes[number] : self._changes[number + 1]]
            change[composites, shape] = scaled * self._spread[composites, shape]
        return _Found(unknowns[: system.starts[-1]], change, steps == 0)

    def _applied(self, x: FloatArray) -> FloatArray:
        x = x.ravel()
        return np.asarray(x + self._pulled(self._system.trust[:, :, None] * self._pushed(x)))

    def _pushed(self, x: FloatArray) -> FloatArray:
        """(c, s, 3) what the unknowns add to the composites."""
        system = self._system
        added = np.zeros((*system.trust.shape, 3))
        for number, (row, field) in enumerate(zip(system.rows, system.shape_fields(x), strict=True)):
            personal = bent(field, row.template)
            for composite in self._uses[number]:
                added[composite, row.points] += self._weights[composite, row.shape] * personal
            for place, composite in enumerate(self._moving[number], self._changes[number]):
                added[composite, row.points] += x[place] * self._spread[composite, row.shape] * row.template
        return added

    def _pulled(self, forces: FloatArray) -> FloatArray:
        """The transpose of `_pushed`."""
        system, result, fields = self._system, np.zeros(int(self._changes[-1])), []
        for number, row in enumerate(system.rows):
            weights = self._weights[self._uses[number], row.shape]
            force = np.tensordot(weights, forces[self._uses[number]][:, row.points], axes=1)
            fields.append(bent_back(force, row.template))
            for place, composite in enumerate(self._moving[number], self._changes[number]):
                along = (row.template * forces[composite, row.points]).sum()
                result[place] = self._spread[composite, row.shape] * along
        result[: system.starts[-1]] = system.pulled(fields)
        return result

    def _weight_diagonal(self) -> FloatArray:
        """(w,) of the system's matrix at the changes of weights."""
        diagonal = []
        for number, (composites, shape) in enumerate(self._pairs(self._moving)):
            squares = (self._system.rows[number].template ** 2).sum(axis=1)
            information = self._system.trust[composites][:, self._system.rows[number].points] @ squares
            diagonal.append(1.0 + self._spread[composites, shape] ** 2 * information)
        return np.concatenate(diagonal) if diagonal else np.zeros(0)


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
            information = (weights[:, row.shape] ** 2) @ system.trust[:, row.points]
            products = information[:, None, None] * _products(row.template)
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
    """(p, 3, 4) the Jacobian of that motion: the delta itself, and its turns about the axes."""
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
    """(4k, 4k) the identity and the sum over points (p), with basis values (p, k) and products (p, 4, 4)."""
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
