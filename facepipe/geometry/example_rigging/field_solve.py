"""Gains, turns and weights together: Gauss-Newton steps on the composites, by conjugate gradients."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.options import SplitOptions
from facepipe.geometry.polygons import point_areas
from facepipe.geometry.vectors import finite, group_sums

_SAMPLES_PER_LENGTH = 4.0  # sampled points per length of fields
_NODE_SPACING = 1.1  # lengths of fields between nodes
_STILL_SHARE = 0.02  # a point moves with a shape if by more than this share of the shape's largest motion
_NODE_JITTER = 1e-6  # of the nodes' covariance: keeps its factor definite
_CONSTANT_VARIANCE = 0.25  # share of the variance that is the same at all points
_CG_TOLERANCE = 1e-4  # of the right-hand side that conjugate gradients leave
_CG_STEPS = 400


@dataclass(frozen=True, kw_only=True)
class Examples:
    """Arrays that fit each other, float64 and finite."""

    neutral: FloatArray  # (n, 3)
    triangles: IntArray  # (t, 3)
    templates: FloatArray  # (e, n, 3) deltas
    offsets: FloatArray  # (c, n, 3) composites less the neutral
    weights: FloatArray  # (c, e) as given
    confidence: FloatArray  # (c, n) 0..1
    areas: FloatArray  # (n,) of the neutral around each point, above 0
    stiff: IntArray  # (n,) the piece that bends no more than its templates, -1 for none

    @property
    def excited(self) -> IntArray:
        """The shapes that some composite holds."""
        return np.flatnonzero(self.weights.any(axis=0))

    def residuals(self, deltas: FloatArray, weights: FloatArray) -> FloatArray:
        """(c, n, 3) what `deltas` (e, n, 3) with `weights` (c, e) leave of the composites."""
        return self.offsets - np.tensordot(weights, deltas, axes=1)


def examples_of(
    neutral: FloatArray,
    templates: FloatArray,
    composites: FloatArray,
    weights: FloatArray,
    triangles: IntArray,
    confidence: FloatArray,
    stiff: IntArray,
) -> Examples:
    """The examples; arguments and errors as those of `split_shapes`."""
    points = finite("neutral", neutral)
    areas = point_areas(points, triangles)
    return Examples(
        neutral=points,
        triangles=np.asarray(triangles, np.int64),
        templates=finite("template deltas", templates),
        offsets=finite("composites", composites) - points,
        weights=weights,
        confidence=confidence,
        # a point without a triangle has no area: with a hold of 0 the detail's system would be singular there
        areas=np.maximum(areas, 1e-6 * (areas.mean() or 1.0)),
        stiff=np.maximum(np.asarray(stiff, np.int64), -1),
    )


@dataclass(frozen=True)
class ShapeRows:
    """One shape at the sampled points that it moves."""

    shape: int
    points: IntArray  # (p,) into the samples
    basis: SmoothBasis
    values: FloatArray  # (p, k) of the basis there
    template: FloatArray  # (p, 3)


class FieldSystem:
    """The fields' part of the system: everything but the weights.

    Unknowns, all of spread 1: per excited shape (4, k) of its own field, then (4, k) of the shared one: gain, turn x,
    y and z; then one per weight that is not 0.
    """

    def __init__(self, examples: Examples, options: SplitOptions) -> None:
        from scipy.spatial import cKDTree

        self.examples = examples
        length = options.field_length
        self.sample = spread_points(examples.neutral, length / _SAMPLES_PER_LENGTH)
        points = examples.neutral[self.sample]
        self.rows: list[ShapeRows] = []
        for shape in examples.excited:
            template = examples.templates[shape][self.sample]
            motion = np.linalg.norm(template, axis=1)
            moved = np.flatnonzero(motion > _STILL_SHARE * motion.max(initial=0.0))
            if len(moved):
                basis = SmoothBasis(points[moved][spread_points(points[moved], _NODE_SPACING * length)], length)
                self.rows.append(ShapeRows(int(shape), moved, basis, basis(points[moved]), template[moved]))
        moving = points[np.unique(np.concatenate([row.points for row in self.rows]))] if self.rows else points
        self.shared = SmoothBasis(moving[spread_points(moving, _NODE_SPACING * length)], length)
        self.shared_values = self.shared(points)
        self.own_spread = np.array([options.own_gain, *3 * [options.own_turn / np.sqrt(3.0)]])
        self.shared_spread = np.array([options.shared_gain, *3 * [options.shared_turn / np.sqrt(3.0)]])
        # (c, s) inverse variance of each sampled point: the area that it stands for, in areas of one error. What fields
        # can't hold of the templates' motion counts as error here
        nearest = cKDTree(points).query(examples.neutral)[1]
        areas = [np.bincount(nearest, examples.areas * row, minlength=len(self.sample)) for row in examples.confidence]
        squares = (examples.templates[:, self.sample] ** 2).sum(axis=2) / 3.0
        unheld = options.detail**2 * (examples.weights**2 @ squares)
        self.trust = np.asarray(np.array(areas) / options.noise_length**2 / (options.noise**2 + unheld))
        sizes = [4 * len(row.basis) for row in self.rows] + [4 * len(self.shared)]
        self.starts = np.concatenate([[0], np.cumsum(sizes)])

    def fields(self, z: FloatArray, part: int, values: FloatArray) -> FloatArray:
        """(p, 4) gain and turn of one part (that of a shape; last: shared), by basis values (p, k)."""
        amplitudes = z[self.starts[part] : self.starts[part + 1]].reshape(4, -1)
        return np.asarray(values @ amplitudes.T * (self.shared_spread if part == len(self.rows) else self.own_spread))

    def shape_fields(self, z: FloatArray) -> list[FloatArray]:
        """The whole gain and turn (p, 4) of each excited shape at its sampled points."""
        shared = self.fields(z, len(self.rows), self.shared_values)
        return [self.fields(z, part, row.values) + shared[row.points] for part, row in enumerate(self.rows)]

    def pulled(self, forces: list[FloatArray]) -> FloatArray:
        """The transpose of `shape_fields`: (p, 4) per excited shape -> (z,)."""
        z = np.empty(self.starts[-1])
        shared = np.zeros((len(self.sample), 4))
        for part, (row, force) in enumerate(zip(self.rows, forces, strict=True)):
            shared[row.points] += force
            z[self.starts[part] : self.starts[part + 1]] = ((force * self.own_spread).T @ row.values).ravel()
        z[self.starts[-2] :] = ((shared * self.shared_spread).T @ self.shared_values).ravel()
        return z

    def deltas(self, z: FloatArray) -> FloatArray:
        """(e, n, 3) the templates with the person's gains and turns; unexcited ones as they are."""
        result = self.examples.templates.copy()
        points = self.examples.neutral
        shared = self.fields(z, len(self.rows), self.shared(points))
        for part, row in enumerate(self.rows):
            moving = np.flatnonzero(result[row.shape].any(axis=1))
            field = self.fields(z, part, row.basis(points[moving])) + shared[moving]
            stiff = self.examples.stiff[moving]
            inside = stiff >= 0
            if inside.any():  # a stiff piece has one gain and turn all over: their mean
                labels, group = np.unique(stiff[inside], return_inverse=True)
                means = group_sums(group, field[inside], len(labels)) / np.bincount(group)[:, None]
                field[inside] = means[group]
            result[row.shape, moving] += bent(field, result[row.shape, moving])
        return result


def bent(field: FloatArray, template: FloatArray) -> FloatArray:
    """(p, 3) what gains and turns (p, 4) add to deltas (p, 3)."""
    return np.asarray(field[:, :1] * template + crossed(field[:, 1:], template))


def crossed(a: FloatArray, b: FloatArray) -> FloatArray:
    """(p, 3) cross products, axis by axis: much faster than np.cross."""
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=1)


def spread_points(points: FloatArray, spacing: float) -> IntArray:
    """Indices of points such that none of all is further than `spacing` from one of them, each far from the others.

    The first is the one furthest from the centroid, every next one that furthest from all before.
    """
    nearest = ((points - points.mean(axis=0)) ** 2).sum(axis=1)
    chosen = [int(nearest.argmax())]
    nearest = np.full(len(points), np.inf)
    columns = np.ascontiguousarray(points.T)
    while True:
        apart = sum((axis - axis[chosen[-1]]) ** 2 for axis in columns)
        np.minimum(nearest, apart, out=nearest)
        furthest = int(nearest.argmax())
        if nearest[furthest] <= spacing * spacing:
            return np.array(chosen)
        chosen.append(furthest)


class SmoothBasis:
    """Functions f_k such that ``sum_k z_k f_k`` with independent z_k of spread 1 has the covariance
    ``1/4 + 3/4 exp(-|x - y|^2 / 2 length^2)`` near the nodes: a quarter of the variance is the same everywhere, f_0,
    the rest a Gaussian process by its values at the nodes (Quiñonero-Candela & Rasmussen, "A unifying view of sparse
    approximate Gaussian process regression", JMLR 2005, section 4).

    :param nodes: (k, 3)
    """

    def __init__(self, nodes: FloatArray, length: float) -> None:
        self.nodes, self._length = nodes, length
        self._factor = np.linalg.cholesky(self._covariance(nodes) + _NODE_JITTER * np.eye(len(nodes)))

    def __len__(self) -> int:
        return 1 + len(self.nodes)

    def __call__(self, points: FloatArray) -> FloatArray:
        """(p, k) values of the functions at points (p, 3)."""
        from scipy.linalg import solve_triangular

        values = np.full((len(self), len(points)), np.sqrt(_CONSTANT_VARIANCE))
        values[1:] = solve_triangular(self._factor, self._covariance(points).T, lower=True, overwrite_b=True)
        values[1:] *= np.sqrt(1.0 - _CONSTANT_VARIANCE)
        return np.asarray(values.T)

    def _covariance(self, points: FloatArray) -> FloatArray:
        scaled, nodes = points / self._length, self.nodes / self._length
        squares = (scaled * scaled).sum(axis=1)[:, None] + (nodes * nodes).sum(axis=1) - 2.0 * scaled @ nodes.T
        return np.asarray(np.exp(-0.5 * np.maximum(squares, 0.0)))


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
        start, diagonal = np.zeros(size), [np.zeros(0)]  # the matrix's at the changes of weights
        start[: len(self._z)] = self._z
        for number, (composites, shape) in enumerate(self._pairs(self._moving)):
            spread, row = self._spread[composites, shape], system.rows[number]
            # the prior holds weights to the given ones: held to those of the last step they would drift
            behind = (given_weights[composites, shape] - self._weights[composites, shape]) / spread
            right[self._changes[number] : self._changes[number + 1]] += behind
            information = system.trust[composites][:, row.points] @ (row.template**2).sum(axis=1)
            diagonal.append(1.0 + spread**2 * information)
        if not right.any():
            return _Found(np.zeros(system.starts[-1]), np.zeros_like(given_weights), True)
        matrix = LinearOperator((size, size), matvec=self._applied, dtype=np.float64)
        guess = Preconditioner(system, self._weights, np.concatenate(diagonal))
        inverse = LinearOperator((size, size), matvec=guess.solve, dtype=np.float64)
        unknowns, steps = cg(matrix, right, x0=start, rtol=_CG_TOLERANCE, maxiter=_CG_STEPS, M=inverse)
        change = np.zeros_like(given_weights)
        for number, (composites, shape) in enumerate(self._pairs(self._moving)):
            scaled = unknowns[self._changes[number] : self._changes[number + 1]]
            change[composites, shape] = scaled * self._spread[composites, shape]
        return _Found(unknowns[: system.starts[-1]], change, steps == 0)

    def _applied(self, x: FloatArray) -> FloatArray:
        x = x.ravel()
        # (c, s, 3) what the unknowns add to the composites
        system = self._system
        added = np.zeros((*system.trust.shape, 3))
        for number, (row, field) in enumerate(zip(system.rows, system.shape_fields(x), strict=True)):
            personal = bent(field, row.template)
            for composite in self._uses[number]:
                added[composite, row.points] += self._weights[composite, row.shape] * personal
            for place, composite in enumerate(self._moving[number], self._changes[number]):
                added[composite, row.points] += x[place] * self._spread[composite, row.shape] * row.template
        return np.asarray(x + self._pulled(self._system.trust[:, :, None] * added))

    def _pulled(self, forces: FloatArray) -> FloatArray:
        """P^T of forces (c, s, 3) on the composites."""
        system, result, fields = self._system, np.zeros(int(self._changes[-1])), []
        for number, row in enumerate(system.rows):
            weights = self._weights[self._uses[number], row.shape]
            force = np.tensordot(weights, forces[self._uses[number]][:, row.points], axes=1)
            # (p, 4) the transpose of `bent` for forces (p, 3)
            gain = (force * row.template).sum(axis=1, keepdims=True)
            fields.append(np.concatenate([gain, crossed(row.template, force)], axis=1))
            for place, composite in enumerate(self._moving[number], self._changes[number]):
                along = (row.template * forces[composite, row.points]).sum()
                result[place] = self._spread[composite, row.shape] * along
        result[: system.starts[-1]] = system.pulled(fields)
        return result


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
        # (s, 4, 4) of the composites that templates make
        total = np.zeros((len(system.sample), 4, 4))
        for weight, trust in zip(weights, system.trust, strict=True):
            made = np.tensordot(weight, system.examples.templates[:, system.sample], axes=1)
            total += trust[:, None, None] * _products(made)
        shared = _block(system.shared_values, total, system.shared_spread)
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
    # (p, 3, 4) the Jacobian of that motion: the delta itself, and its turns about the axes
    axes = [crossed(np.broadcast_to(axis, delta.shape), delta) for axis in np.eye(3)]
    columns = np.stack([delta, *axes], axis=2)
    return np.asarray(columns.transpose(0, 2, 1) @ columns)


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
