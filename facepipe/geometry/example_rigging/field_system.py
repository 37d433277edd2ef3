"""The linear system of a person's gains and turns, and of small changes of weights, over all shapes and composites.

A personal shape is its template with a gain and a turn that vary smoothly over the face, in part alike for all shapes
(a person with a strong, stiff or lopsided face) and in part of the shape's own (a strong or slanting muscle):
``delta = template + gain template + turn x template``. Both parts are Gaussian processes; what composites show of
them is a linear least-squares problem with a diagonal prior, solved by conjugate gradients without its matrix.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.example_rigging.examples import Examples
from facepipe.geometry.example_rigging.options import SplitOptions
from facepipe.geometry.vectors import group_sums

_SAMPLES_PER_LENGTH = 4.0  # sampled points per length of fields
_NODE_SPACING = 1.1  # lengths of fields between nodes
_STILL_SHARE = 0.02  # a point moves with a shape if by more than this share of the shape's largest motion
_NODE_JITTER = 1e-6  # of the nodes' covariance: keeps its factor definite
_CONSTANT_VARIANCE = 0.25  # share of the variance that is the same at all points


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
        self.examples = examples
        length = options.field_length
        self.sample = spread_points(examples.neutral, length / _SAMPLES_PER_LENGTH)
        self.rows = _shape_rows(examples, self.sample, length)
        points = examples.neutral[self.sample]
        moved = np.unique(np.concatenate([row.points for row in self.rows])) if self.rows else self.sample
        nodes = spread_points(points[moved], _NODE_SPACING * length)
        self.shared = SmoothBasis(points[moved][nodes], length)
        self.shared_values = self.shared(points)
        self.own_spread = np.array([options.own_gain, *3 * [options.own_turn / np.sqrt(3.0)]])
        self.shared_spread = np.array([options.shared_gain, *3 * [options.shared_turn / np.sqrt(3.0)]])
        self.trust = _trust(examples, self.sample, options)
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
            field = _even(self.fields(z, part, row.basis(points[moving])) + shared[moving], self.examples.stiff[moving])
            result[row.shape, moving] += bent(field, result[row.shape, moving])
        return result


def bent(field: FloatArray, template: FloatArray) -> FloatArray:
    """(p, 3) what gains and turns (p, 4) add to deltas (p, 3)."""
    return np.asarray(field[:, :1] * template + crossed(field[:, 1:], template))


def bent_back(force: FloatArray, template: FloatArray) -> FloatArray:
    """(p, 4) the transpose of `bent` for forces (p, 3)."""
    gain = (force * template).sum(axis=1, keepdims=True)
    return np.concatenate([gain, crossed(template, force)], axis=1)


def _even(field: FloatArray, stiff: IntArray) -> FloatArray:
    """(p, 4) fields, the same all over each stiff piece (p,): their mean there."""
    inside = stiff >= 0
    if not inside.any():
        return field
    labels, group = np.unique(stiff[inside], return_inverse=True)
    means = group_sums(group, field[inside], len(labels)) / np.bincount(group)[:, None]
    result = field.copy()
    result[inside] = means[group]
    return result


def crossed(a: FloatArray, b: FloatArray) -> FloatArray:
    """(p, 3) cross products, axis by axis: much faster than np.cross."""
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=1)


def _shape_rows(examples: Examples, sample: IntArray, length: float) -> list[ShapeRows]:
    points, rows = examples.neutral[sample], []
    for shape in examples.excited:
        template = examples.templates[shape][sample]
        motion = np.linalg.norm(template, axis=1)
        moved = np.flatnonzero(motion > _STILL_SHARE * motion.max(initial=0.0))
        if len(moved):
            nodes = spread_points(points[moved], _NODE_SPACING * length)
            basis = SmoothBasis(points[moved][nodes], length)
            rows.append(ShapeRows(int(shape), moved, basis, basis(points[moved]), template[moved]))
    return rows


def _trust(examples: Examples, sample: IntArray, options: SplitOptions) -> FloatArray:
    """(c, s) inverse variance of each sampled point: the area that it stands for, in areas of one error.

    What fields can't hold of the templates' motion counts as error here.
    """
    from scipy.spatial import cKDTree

    nearest = cKDTree(examples.neutral[sample]).query(examples.neutral)[1]
    areas = [np.bincount(nearest, examples.areas * row, minlength=len(sample)) for row in examples.confidence]
    squares = (examples.templates[:, sample] ** 2).sum(axis=2) / 3.0
    unheld = options.detail**2 * (examples.weights**2 @ squares)
    return np.asarray(np.array(areas) / options.noise_length**2 / (options.noise**2 + unheld))


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
