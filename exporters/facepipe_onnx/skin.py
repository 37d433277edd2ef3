"""Linear blend skinning as nodes: world matrices and morphed points -> world points."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray
from facepipe.onnx_graph import Nodes
from facepipe.rig import Rig
from facepipe_onnx.joints import tree_order
from facepipe_onnx.partition import Partition

ENTRY_BYTES = 4  # one skin weight


# (j, 4, 4) constants at the joints -> [batch, joints, 4, 4] world matrices times them, joints sorted by depth
Ends = Callable[[FloatArray], str]


def skinning_nodes(nodes: Nodes, rig: Rig, ends: Ends | None, centre: FloatArray, *, parent: bool, batch: int) -> str:
    """[batch, 12, joints + 1] matrices from centred skeleton space to world, entry ``3 * column + row``.

    Joints are sorted by depth, the skeleton's own matrix is last.

    :param ends: None if there are no joints
    :param centre: (3,) skeleton-space origin of the points; keeps products of float32 small
    """
    shift = np.eye(4)
    shift[:3, 3] = centre
    matrices = [] if ends is None else [ends(rig.inverse_bind @ shift)]
    if parent:
        shifted = nodes.add("MatMul", "parent", nodes.constant("centre", shift))
        matrices.append(nodes.reshape(shifted, batch, 1, 4, 4))
    else:
        own = np.tile(rig.parent_world @ shift, (batch, 1, 1, 1))
        matrices.append(nodes.constant("skeleton_world", own))
    rows = nodes.slice(nodes.concat(matrices, 1), 2, 0, 3)
    count = len(rig.joints) + 1
    return nodes.reshape(nodes.add("Transpose", rows, perm=[0, 3, 2, 1]), batch, 12, count)


def skin_nodes(nodes: Nodes, rig: Rig, matrices: str, points: str, parts: Partition, batch: int) -> str:
    """[batch, 3, points] world points in the order of the partition's groups.

    :param matrices: [batch, 12, joints + 1] of `skinning_nodes`
    :param points: [batch, 4, points] homogeneous centred points in the same order, or 1 instead of batch
    """
    blended = nodes.concat([_blend(nodes, matrices, rig, parts, i) for i in range(len(parts.groups))], 2)
    total = sum(len(group.blocks) for group in parts.groups) * parts.size
    blended = nodes.reshape(blended, batch, 4, 3, total)
    products = nodes.add("Mul", blended, nodes.reshape(points, -1, 4, 1, total))
    flat = nodes.reshape(products, batch, 4, 3 * total)
    summed = nodes.add("MatMul", nodes.constant("sum_of_columns", np.ones((1, 4))), flat)
    return nodes.reshape(summed, batch, 3, total)


def joint_columns(rig: Rig) -> npt.NDArray[np.integer]:
    """(joints + 1,) joints in the column order of `skinning_nodes`."""
    return np.append(tree_order(rig.parents)[0], len(rig.joints))


def _blend(nodes: Nodes, matrices: str, rig: Rig, parts: Partition, number: int) -> str:
    group = parts.groups[number]
    weights = rig.influences[:, joint_columns(rig)][parts.members(group)][:, group.columns]
    own = nodes.gather(matrices, 2, group.columns)
    return nodes.add("MatMul", own, nodes.constant("skin_weights", weights.toarray().T))
