"""The joint tree as nodes: bone coefficients or local transforms -> world matrices (DESIGN section 7)."""

from __future__ import annotations

import itertools

import numpy as np

from facepipe.core.arrays import IntArray
from facepipe.onnx_graph import Nodes
from facepipe.rig import Rig
from facepipe_onnx.transforms import local_nodes


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
    local = source if matrices else local_nodes(nodes, source, rig.rest[order], batch)
    root = nodes.reshape("parent", batch, 1, 4, 4) if parent else nodes.constant("parent_world", rig.parent_world)
    above = np.argsort(order, kind="stable")[rig.parents[order]]
    return level_nodes(nodes, local, above, starts, root)


def level_nodes(nodes: Nodes, local: str, above: IntArray, starts: IntArray, root: str | None) -> str:
    """[batch, rows, 4, 4] products down a tree whose rows are sorted by depth: one MatMul a level.

    :param local: [batch, rows, 4, 4]
    :param above: (rows,) the row above, in the level before; not read on level 0
    :param starts: (levels + 1,) first row of each level, and their count
    :param root: what level 0 hangs under, None for nothing
    """
    levels: list[str] = []
    for depth, (start, end) in enumerate(itertools.pairwise(starts)):
        own = nodes.slice(local, 1, int(start), int(end))
        if depth > 0:
            own = nodes.add("MatMul", nodes.gather(levels[-1], 1, above[start:end] - starts[depth - 1]), own)
        elif root is not None:
            own = nodes.add("MatMul", root, own)
        levels.append(own)
    return nodes.concat(levels, 1)
