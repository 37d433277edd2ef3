"""Bone coefficients as nodes: to local matrices, in few nodes that do little (DESIGN section 7)."""

from __future__ import annotations

import itertools

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.onnx_graph import Nodes

_ORDER = (2, 0, 1)  # axes of Rz Rx Ry


def local_nodes(nodes: Nodes, coefficients: str, rest: FloatArray, batch: int) -> str:
    """[batch, j, 4, 4] ``rest T(t) Rz(rz) Rx(rx) Ry(ry) S(s)`` of [batch, j, 9] coefficients.

    Each entry of the 4x4 is a sum of products of one sine, cosine or 1 for each axis, and a scale: all products of all
    joints are made at once, column by column.

    :param rest: (j, 4, 4) constants
    """
    count = len(rest)
    rows = nodes.reshape(coefficients, batch * count, 9)
    angles = nodes.slice(rows, 1, 3, 6)
    waves = nodes.concat([nodes.add("Sin", angles), nodes.add("Cos", angles)], 1)
    scale, entries = _scale_columns(), _entry_rows()
    product = nodes.add("MatMul", rows, nodes.constant("scales", scale))
    for place, axis in enumerate(_ORDER):
        linear, fixed = _factor_columns(place, axis)
        factor = nodes.add("Gemm", waves, nodes.constant(f"turns_{axis}", linear), nodes.constant("fixed_turns", fixed))
        product = nodes.add("Mul", product, factor)
    corner = nodes.constant("corner", np.eye(16)[15])
    matrices = nodes.add("Gemm", product, nodes.constant("entries", entries), corner)
    return nodes.add("MatMul", nodes.constant("rest", rest), nodes.reshape(matrices, batch, count, 4, 4))


def _axis_rotation(axis: int) -> tuple[FloatArray, FloatArray]:
    """(6, 3, 3) and (3, 3): a rotation about `axis` is ``[sin x y z, cos x y z] @ linear + fixed``."""
    first, second = (axis + 1) % 3, (axis + 2) % 3
    linear, fixed = np.zeros((6, 3, 3)), np.zeros((3, 3))
    linear[axis, first, second], linear[axis, second, first] = -1.0, 1.0
    linear[3 + axis, first, first] = linear[3 + axis, second, second] = 1.0
    fixed[axis, axis] = 1.0
    return linear, fixed


def _products() -> list[tuple[int, int, int, int]]:
    """The products i k l j that are not zero: ``R[i, j]`` sums ``Rz[i, k] Rx[k, l] Ry[l, j]``."""
    turns = [_axis_rotation(axis) for axis in _ORDER]
    first, second, third = (np.abs(linear).sum(axis=0) + fixed != 0 for linear, fixed in turns)
    indices = itertools.product(range(3), repeat=4)
    return [(i, k, m, j) for i, k, m, j in indices if first[i, k] and second[k, m] and third[m, j]]


def _factor_columns(place: int, axis: int) -> tuple[FloatArray, FloatArray]:
    """(6, p + 3) and (p + 3,): the factor of one axis in every product, and a 1 for each translation."""
    linear, fixed = _axis_rotation(axis)
    rows, columns = np.array([product[place : place + 2] for product in _products()]).T
    return np.hstack([linear[:, rows, columns], np.zeros((6, 3))]), np.append(fixed[rows, columns], np.ones(3))


def _scale_columns() -> FloatArray:
    """(9, p + 3): the scale in every product, then the translations, out of the coefficients."""
    columns = [6 + j for *_, j in _products()] + [0, 1, 2]
    return np.eye(9)[:, columns]


def _entry_rows() -> FloatArray:
    """(p + 3, 16): which entry of the matrix, row by row, each product belongs to."""
    return np.eye(16)[[4 * i + j for i, *_, j in _products()] + [3, 7, 11]]
