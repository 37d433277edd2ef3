"""The joint tree as nodes: bone coefficients or local transforms -> world matrices (DESIGN section 7)."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.onnx_graph import Nodes
from facepipe.rig import Rig

_ORDER = (2, 0, 1)  # axes of Rz Rx Ry


def _local_nodes(nodes: Nodes, coefficients: str, rest: FloatArray, batch: int) -> str:
    """[batch, j, 4, 4] ``rest T(t) Rz(rz) Rx(rx) Ry(ry) S(s)`` of [batch, j, 9] coefficients.

    Each entry of the 4x4 is a sum of products of one sine, cosine or 1 for each axis, and a scale: all products of all
    joints are made at once, column by column.

    :param rest: (j, 4, 4) constants
    """
    count = len(rest)
    rows = nodes.reshape(coefficients, batch * count, 9)
    angles = nodes.slice(rows, 1, 3, 6)
    waves = nodes.concat([nodes.add("Sin", angles), nodes.add("Cos", angles)], 1)
    # the products i k m j that are not zero: R[i, j] sums Rz[i, k] Rx[k, m] Ry[m, j]
    turns = []
    for axis in _ORDER:  # a rotation about it is ``[sin x y z, cos x y z] @ linear + fixed``
        after, last = (axis + 1) % 3, (axis + 2) % 3
        linear, fixed = np.zeros((6, 3, 3)), np.zeros((3, 3))
        linear[axis, after, last], linear[axis, last, after] = -1.0, 1.0
        linear[3 + axis, after, after] = linear[3 + axis, last, last] = 1.0
        fixed[axis, axis] = 1.0
        turns.append((linear, fixed))
    first, second, third = (np.abs(linear).sum(axis=0) + fixed != 0 for linear, fixed in turns)
    indices = itertools.product(range(3), repeat=4)
    products = [(i, k, m, j) for i, k, m, j in indices if first[i, k] and second[k, m] and third[m, j]]
    # (9, p + 3): the scale in every product, then the translations, out of the coefficients
    columns = [6 + j for *_, j in products] + [0, 1, 2]
    scale, entries = np.eye(9)[:, columns], np.eye(16)[[4 * i + j for i, *_, j in products] + [3, 7, 11]]
    product = nodes.add("MatMul", rows, nodes.constant("scales", scale))
    for place, (axis, (turn, still)) in enumerate(zip(_ORDER, turns, strict=True)):
        # the factor of one axis in every product, and a 1 for each translation
        i, j = np.array([product[place : place + 2] for product in products]).T
        linear, fixed = np.hstack([turn[:, i, j], np.zeros((6, 3))]), np.append(still[i, j], np.ones(3))
        factor = nodes.add("Gemm", waves, nodes.constant(f"turns_{axis}", linear), nodes.constant("fixed_turns", fixed))
        product = nodes.add("Mul", product, factor)
    # the 1 at the end of a matrix depends on nothing: it is the bias of the product
    corner = nodes.constant("corner", np.eye(16)[15])
    matrices = nodes.add("Gemm", product, nodes.constant("entries", entries), corner)
    return nodes.add("MatMul", nodes.constant("rest", rest), nodes.reshape(matrices, batch, count, 4, 4))


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
    local = source if matrices else _local_nodes(nodes, source, rig.rest[order], batch)
    root = nodes.reshape("parent", batch, 1, 4, 4) if parent else nodes.constant("parent_world", rig.parent_world)
    above = np.argsort(order, kind="stable")[rig.parents[order]]
    return _level_nodes(nodes, local, above, starts, root)


def _level_nodes(nodes: Nodes, local: str, above: IntArray, starts: IntArray, root: str | None) -> str:
    """[batch, rows, 4, 4] products down a tree whose rows are sorted by depth: one MatMul a level.

    :param local: [batch, rows, 4, 4]
    :param above: (rows,) the row above, in the level before; not read on level 0
    :param starts: (levels + 1,) first row of each level, and their count
    :param root: what level 0 hangs under, None for nothing
    """
    levels: list[str] = []
    for depth, (start, end) in enumerate(itertools.pairwise(starts)):
        level = nodes.slice(local, 1, int(start), int(end))
        if depth > 0:
            level = nodes.add("MatMul", nodes.gather(levels[-1], 1, above[start:end] - starts[depth - 1]), level)
        elif root is not None:
            level = nodes.add("MatMul", root, level)
        levels.append(level)
    return nodes.concat(levels, 1)


class Chains(NamedTuple):
    """Rows: the joints that move, sorted by depth among themselves; last on level 0 one that stays at rest."""

    joints: IntArray  # (n,) joint of each row, -1 for the one at rest
    rows: IntArray  # (j,) row with the coefficients of each joint
    above: IntArray  # (n,) row that each row hangs under, of the level before
    levels: IntArray  # (levels + 1,) first row of each level, and their count
    rest: FloatArray  # (n, 4, 4) from the row above, or from what roots hang under, to each row at rest
    anchors: IntArray  # (j,) row that carries each joint: its own, the nearest above, or the one at rest
    ends: FloatArray  # (j, 4, 4) from that row to the joint


def chains_of(rig: Rig, moving: npt.NDArray[np.bool_], root: FloatArray) -> Chains:
    """The chains of a rig.

    :param moving: (j,) which joints move
    :param root: (4, 4) what roots hang under
    """
    count = len(rig.joints)
    anchor, above = np.full(count, -1), np.full(count, -1)
    ends, starts = np.zeros((count, 4, 4)), np.zeros((count, 4, 4))
    for joint, parent in enumerate(rig.parents):
        before, path = (-1, root) if parent < 0 else (anchor[parent], ends[parent])
        reached = path @ rig.rest[joint]
        # a joint that no slider moves is no product at run time: its rest is part of the next constant below
        if moving[joint]:
            above[joint], starts[joint], anchor[joint], ends[joint] = before, reached, joint, np.eye(4)
        else:
            anchor[joint], ends[joint] = before, reached
    movers = np.flatnonzero(moving)
    place = np.searchsorted(movers, above[movers])
    order, levels = tree_order(np.where(above[movers] < 0, -1, place))
    still = int(levels[1]) if len(levels) > 1 else 0
    joints = np.insert(movers[order], still, -1)
    levels = np.concatenate([[0], levels[1:] + 1]) if len(movers) else np.array([0, 1])
    row = np.full(count + 1, still)  # the last entry stands for joint -1
    row[joints] = np.arange(len(joints))
    row[-1] = still
    at_rest = np.where((joints < 0)[:, None, None], np.eye(4), starts[joints])
    hanging = row[np.where(joints < 0, -1, above[joints])]
    return Chains(joints, row[:count], hanging, levels, at_rest, row[anchor], ends)


def chain_nodes(nodes: Nodes, chains: Chains, coefficients: str, *, parent: bool, batch: int) -> str:
    """[batch, n, 4, 4] world matrices of the rows of `chains`, from their [batch, n, 9] coefficients.

    :param parent: the matrix that roots hang under is an input
    """
    local = _local_nodes(nodes, coefficients, chains.rest, batch)
    root = nodes.reshape("parent", batch, 1, 4, 4) if parent else None
    return _level_nodes(nodes, local, chains.above, chains.levels, root)


def end_nodes(
    nodes: Nodes, chains: Chains, worlds: str, ends: FloatArray, order: IntArray, name: str | None = None
) -> str:
    """[batch, joints, 4, 4] ``world @ ends`` of the joints in `order`.

    :param worlds: of `chain_nodes`
    :param ends: (j, 4, 4) constants at the joints, such as inverse bind transforms
    """
    carried = worlds
    if not np.array_equal(chains.anchors[order], np.arange(len(chains.joints))):
        carried = nodes.gather(worlds, 1, chains.anchors[order])
    constants = nodes.constant("chain_ends", (chains.ends @ ends)[order])
    return nodes.add("MatMul", carried, constants, name=name)
