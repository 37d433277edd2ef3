"""The joint tree as nodes: bone coefficients or local transforms -> world matrices (DESIGN section 7)."""

from __future__ import annotations

import itertools

import numpy as np
import numpy.typing as npt

from facepipe.rig import Rig
from facepipe_onnx.nodes import Nodes

FloatArray = npt.NDArray[np.floating]
IntArray = npt.NDArray[np.integer]


def tree_order(parents: IntArray) -> tuple[IntArray, IntArray]:
    """Joint numbers sorted by depth, and the first position (levels + 1,) of every depth."""
    depth = np.zeros(len(parents), dtype=np.int64)
    for joint, parent in enumerate(parents):
        depth[joint] = 0 if parent < 0 else depth[parent] + 1
    order = np.argsort(depth, kind="stable")
    return order, np.searchsorted(depth[order], np.arange(depth.max(initial=-1) + 2))


def world_nodes(nodes: Nodes, rig: Rig, *, matrices: bool, parent: bool, batch: int) -> str:
    """[batch, joints, 4, 4] world matrices, joints sorted by depth (`tree_order`).

    :param matrices: local transforms are the input, not bone coefficients
    :param parent: the matrix that roots hang under is an input
    """
    order, starts = tree_order(rig.parents)
    source = nodes.gather("joint_transforms" if matrices else "coefficients", 1, order)
    fixed = None if parent else nodes.constant("parent_world", rig.parent_world)
    local = source if matrices else _local(nodes, source, rig.rest[order], batch)
    position = np.argsort(order, kind="stable")
    levels: list[str] = []
    for depth, (start, end) in enumerate(itertools.pairwise(starts)):
        own = nodes.slice(local, 1, int(start), int(end))
        if depth == 0:
            above = fixed or nodes.reshape("parent", batch, 1, 4, 4)
        else:
            above = nodes.gather(levels[-1], 1, position[rig.parents[order[start:end]]] - starts[depth - 1])
        levels.append(nodes.add("MatMul", above, own))
    return nodes.concat(levels, 1)


def _local(nodes: Nodes, coefficients: str, rest: FloatArray, batch: int) -> str:
    """[batch, j, 4, 4] ``rest T(t) Rz(rz) Rx(rx) Ry(ry) S(s)`` of [batch, j, 9] coefficients."""
    count = len(rest)
    translation = nodes.reshape(nodes.slice(coefficients, 2, 0, 3), batch, count, 3, 1)
    scale = nodes.reshape(nodes.slice(coefficients, 2, 6, 9), batch, count, 1, 3)
    rotation = nodes.add("Mul", _rotation(nodes, coefficients, batch, count), scale)
    last_row = nodes.constant("last_row", np.tile([0.0, 0.0, 0.0, 1.0], (batch, count, 1, 1)))
    upper = nodes.concat([rotation, translation], 3)
    return nodes.add("MatMul", nodes.constant("rest", rest), nodes.concat([upper, last_row], 2))


def _rotation(nodes: Nodes, coefficients: str, batch: int, count: int) -> str:
    """[batch, j, 3, 3] matrices Rz Rx Ry: each factor is linear in the sines and cosines of the angles."""
    angles = nodes.slice(coefficients, 2, 3, 6)
    waves = nodes.concat([nodes.add("Sin", angles), nodes.add("Cos", angles)], 2)
    factors = []
    for axis, name in ((2, "rotate_z"), (0, "rotate_x"), (1, "rotate_y")):
        linear, fixed = _axis_rotation(axis)
        product = nodes.add("MatMul", waves, nodes.constant(name, linear))
        factors.append(
            nodes.reshape(nodes.add("Add", product, nodes.constant(f"{name}_fixed", fixed)), batch, count, 3, 3)
        )
    return nodes.add("MatMul", nodes.add("MatMul", factors[0], factors[1]), factors[2])


def _axis_rotation(axis: int) -> tuple[FloatArray, FloatArray]:
    """(6, 9) and (9,): a rotation about `axis`, row by row, is ``[sin x y z, cos x y z] @ linear + fixed``."""
    first, second = (axis + 1) % 3, (axis + 2) % 3
    linear, fixed = np.zeros((6, 3, 3)), np.zeros((3, 3))
    linear[axis, first, second], linear[axis, second, first] = -1.0, 1.0
    linear[3 + axis, first, first] = linear[3 + axis, second, second] = 1.0
    fixed[axis, axis] = 1.0
    return linear.reshape(6, 9), fixed.ravel()
