"""The joint tree without the joints that nothing moves: these are constants between and behind those that move."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.onnx_graph import Nodes
from facepipe.rig import Rig
from facepipe_onnx.joints import level_nodes, tree_order
from facepipe_onnx.transforms import local_nodes


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
    local = local_nodes(nodes, coefficients, chains.rest, batch)
    root = nodes.reshape("parent", batch, 1, 4, 4) if parent else None
    return level_nodes(nodes, local, chains.above, chains.levels, root)


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
