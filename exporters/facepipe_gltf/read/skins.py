"""All skins of a document as one skeleton.

Joints are the skins' joints, parent first; nodes between them that are no joints are folded into the rest transforms.
A skin's ``inverseBind_i`` are those of glTF 2.0 section 3.7.3.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.parts import Skeleton, identity
from facepipe.rig.binding import Bindings, BoundSkin, unless_flat
from facepipe.rig.trs import compose, decompose
from facepipe_gltf.read import accessors
from facepipe_gltf.read.document import Document, Value, given_name

_POINTER = re.compile(r"/(nodes|meshes)/(\d{1,9})/(translation|rotation|scale|weights)(?:/(\d{1,9}))?")


class Animated(NamedTuple):
    """A property that a channel moves, of one node or of all that show a mesh."""

    nodes: tuple[int, ...]
    path: str  # translation, rotation, scale, weights
    weight: int | None = None  # of its morph weights this one alone


def animated_property(document: Document, target: Value) -> Animated | None:
    """What a channel's target names, by KHR_animation_pointer too; None for another thing.

    A pointer to the weights of a mesh means the nodes that show it and have none of their own, which would win.

    :raises InputError: no such node
    """
    path, node = target.require("path").text(), target.get("node")
    pointer = target.extension("KHR_animation_pointer")
    if path != "pointer" or pointer is None:
        return None if node is None else Animated((document.index("nodes", node),), path)
    match = _POINTER.fullmatch(pointer.require("pointer").text())
    if match is None or (match[4] is not None and match[3] != "weights"):
        return None
    number, weight = int(match[2]), None if match[4] is None else int(match[4])
    if match[1] == "meshes":
        of_mesh = document.unweighted.get(number, ())
        document.budget.spend(8 * len(of_mesh), pointer.error)  # of each channel: nodes times channels would be endless
        return Animated(of_mesh, match[3], weight) if of_mesh and match[3] == "weights" else None
    if number >= len(document.entries("nodes")):
        raise pointer.error(f"nodes[{number}], but there are {len(document.entries('nodes'))}")
    return Animated((number,), match[3], weight)


@dataclass(frozen=True)
class Nodes:
    """All nodes of a document."""

    values: list[Value]
    parents: list[int]  # -1: root
    order: list[int]  # parents first
    locals: FloatArray  # (n, 4, 4)
    worlds: FloatArray  # (n, 4, 4)
    shown: list[int]  # nodes of the scene, depth first


def read_nodes(document: Document, scene: int | None) -> Nodes:
    """All nodes; `scene` chooses what is shown, None is the document's default.

    :raises InputError: cycles, nodes with two parents, indices out of range, transforms that aren't finite
    """
    values = document.entries("nodes")
    children = [[document.index("nodes", child) for child in value.get_or("children", []).items()] for value in values]
    parents = [-1] * len(values)
    for node, below in enumerate(children):
        for child in below:
            if parents[child] >= 0:
                raise values[child].error(
                    f"is a child of nodes[{parents[child]}] and nodes[{node}], expected one parent"
                )
            parents[child] = node
    roots = [node for node, parent in enumerate(parents) if parent < 0]
    order = _depth_first(roots, children)
    # a cycle has no root: no walk from one comes there
    if len(order) < len(values):
        lost = sorted(set(range(len(values))) - set(order))[0]
        raise values[lost].error("is its own ancestor, expected a tree")
    locals_ = np.tile(identity(), (len(values), 1, 1))
    for node, value in enumerate(values):
        if (matrix := value.get("matrix")) is not None:
            locals_[node] = _matrix(matrix)
        elif {"translation", "rotation", "scale"} & set(value.member_names()):
            locals_[node] = compose(*local_trs(value))
    worlds = np.array(locals_)
    for node in order:
        if parents[node] >= 0:
            worlds[node] = worlds[parents[node]] @ locals_[node]
    # finite local matrices are not enough: products of large scales overflow
    finite = np.isfinite(worlds).all(axis=(1, 2))
    if not finite.all():
        raise values[int(np.argmin(finite))].error("its world transform is not finite")
    scenes, default = document.entries("scenes"), document.root.get("scene")
    if scene is not None and not 0 <= scene < len(scenes):
        raise document.root.error(f"scene {scene}, but there are {len(scenes)}")
    if default is not None:
        document.index("scenes", default)
    listed: dict[int, None] = {}
    if scenes:
        chosen = scene if scene is not None else (default.integer() if default is not None else 0)
        for reference in scenes[chosen].get_or("nodes", []).items():
            node = document.index("nodes", reference)
            if parents[node] >= 0 or node in listed:
                raise reference.error(f"nodes[{node}] is not a root or is listed twice")
            listed[node] = None
    shown = _depth_first(list(listed) if scenes else roots, children)
    return Nodes(values, parents, order, locals_, worlds, shown)


def local_trs(value: Value) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A node's translation (3,), rotation x y z w (4,) and scale (3,); a matrix is taken apart."""
    matrix = value.get("matrix")
    if matrix is not None:
        return decompose(_matrix(matrix))[:3]
    rotation = value.get_or("rotation", [0.0, 0.0, 0.0, 1.0])
    quaternion = np.array(rotation.numbers(4))
    length = float(np.linalg.norm(quaternion))
    if not 1e-6 < length < 1e6:
        raise rotation.error("a quaternion without a usable length, expected a unit quaternion")
    return (
        np.array(value.get_or("translation", [0.0] * 3).numbers(3)),
        quaternion if abs(length - 1.0) < 1e-12 else quaternion / length,
        np.array(value.get_or("scale", [1.0] * 3).numbers(3)),
    )


def _matrix(value: Value) -> FloatArray:
    matrix = np.array(value.numbers(16)).reshape(4, 4).T
    if np.abs(matrix[3] - (0.0, 0.0, 0.0, 1.0)).max() > 1e-6:
        raise value.error("its last row is not 0 0 0 1")
    matrix[3] = (0.0, 0.0, 0.0, 1.0)
    return matrix


def _depth_first(roots: list[int], children: list[list[int]]) -> list[int]:
    order: list[int] = []
    stack = list(reversed(roots))
    while stack:
        node = stack.pop()
        order.append(node)
        stack.extend(reversed(children[node]))
    return order


@dataclass(frozen=True)
class Joints:
    """The skeleton, the joint of every node that is one, and what lies between a joint's node and its parent joint."""

    skeleton: Skeleton
    of_node: dict[int, int]
    above: FloatArray  # (j, 4, 4) product of the local matrices of the nodes between, identity where there are none
    skins: tuple[BoundSkin, ...]

    def holding(self, nodes: Nodes, node: int) -> tuple[int, FloatArray] | None:
        """The joint that carries a node, itself or the nearest above, and node space -> joint space."""
        below = identity()
        while node >= 0:
            if node in self.of_node:
                return self.of_node[node], below
            below = nodes.locals[node] @ below
            node = nodes.parents[node]
        return None


def _rigid_nodes(document: Document, nodes: Nodes, joints: set[int]) -> list[int]:
    """Nodes that animations move and that carry a mesh without skin, or joints below them: they become joints."""
    moved: set[int] = set()
    for animation in document.entries("animations"):
        for channel in animation.get_or("channels", []).items():
            found = animated_property(document, channel.require("target"))
            if found is not None and found.path != "weights":
                moved.update(found.nodes)
    carries = [
        node in joints or (value.get("mesh") is not None and value.get("skin") is None)
        for node, value in enumerate(nodes.values)
    ]
    for node in reversed(nodes.order):
        if carries[node] and nodes.parents[node] >= 0:
            carries[nodes.parents[node]] = True
    return [node for node in nodes.order if node in moved - joints and carries[node]]


def read_joints(document: Document, nodes: Nodes, more: tuple[int, ...] = ()) -> Joints:
    """The skeleton of all skins, and of nodes that animations move.

    :param more: nodes that are joints too, whether a skin lists them or not
    :raises InputError: joints out of range or listed twice, inverse binds that are missing, not affine or singular
    """
    values = document.entries("skins")
    listed = [_listed(document, value) for value in values]
    # UsdSkelTopology wants parents before their children, glTF lists joints in any order
    skinned = [node for skin in listed for node in skin]
    rigid = _rigid_nodes(document, nodes, {*skinned})
    order = _parent_first(nodes, [*skinned, *rigid, *more])
    of_node = {node: joint for joint, node in enumerate(order)}
    parents, above = _above(nodes, order, of_node)
    bindings = Bindings()
    skins = []
    for value, joint_nodes in zip(values, listed, strict=True):
        inverses = _inverse_binds(document, value, len(joint_nodes))
        slots = np.array([of_node[node] for node in joint_nodes], np.int64)
        skin, others = bindings.add(slots, inverses, nodes.worlds[joint_nodes])
        if others:
            document.warn(value, f"binds {others} joints otherwise than an earlier skin: joints are added for it")
        skins.append(skin)
    bindings.binds |= {of_node[node]: unless_flat(nodes.worlds[node]) for node in rigid}
    rest = above @ nodes.locals[order] if order else np.zeros((0, 4, 4))
    given = [given_name(nodes.values[node]) for node in order]
    skeleton = bindings.skeleton(given, parents, rest, lambda size: document.budget.spend(size, document.root.error))
    above = np.concatenate([above, np.tile(identity(), (len(bindings.twins), 1, 1))])
    numbered = [bindings.numbered(one, len(order)) for one in skins]
    return Joints(skeleton, of_node, above, tuple(numbered))


def _listed(document: Document, value: Value) -> list[int]:
    """The joint nodes of a skin."""
    joints = [document.index("nodes", joint) for joint in value.require("joints").items()]
    if not joints:
        raise value.error("no joints, expected at least one")
    node, times = Counter(joints).most_common(1)[0]
    if times > 1:
        raise value.error(f"lists nodes[{node}] {times} times, expected once")
    return joints


def _above(nodes: Nodes, order: list[int], of_node: dict[int, int]) -> tuple[list[int], FloatArray]:
    """The parent joint of every joint, -1 for roots, and (j, 4, 4) the product of the nodes between."""
    parents: list[int] = []
    above = np.tile(identity(), (len(order), 1, 1))
    for joint, node in enumerate(order):
        node = nodes.parents[node]
        while node >= 0 and node not in of_node:
            above[joint] = nodes.locals[node] @ above[joint]
            node = nodes.parents[node]
        parents.append(of_node.get(node, -1))
    return parents, above


def _parent_first(nodes: Nodes, joints: list[int]) -> list[int]:
    """The joints without repeats, in the skins' order as far as parents come before children."""
    wanted = set(joints)
    placed: dict[int, None] = {}
    for joint in joints:
        chain = []
        node = joint
        while node >= 0 and node not in placed:
            if node in wanted:
                chain.append(node)
            node = nodes.parents[node]
        placed.update(dict.fromkeys(reversed(chain)))
    return list(placed)


def _inverse_binds(document: Document, value: Value, count: int) -> FloatArray:
    reference = value.get("inverseBindMatrices")
    if reference is None:
        return np.tile(identity(), (count, 1, 1))
    read = accessors.floats(document, reference, "MAT4")
    if len(read) < count:
        raise reference.error(f"{len(read)} matrices, expected one for each of {count} joints")
    matrices = np.asarray(read[:count], np.float64).reshape(-1, 4, 4).transpose(0, 2, 1)
    affine = np.abs(matrices[:, 3] - (0.0, 0.0, 0.0, 1.0)).max(axis=1) <= 1e-6
    if not affine.all():
        raise reference.error(f"matrix {int(np.argmin(affine))} has a last row other than 0 0 0 1")
    matrices[:, 3] = (0.0, 0.0, 0.0, 1.0)
    sizes = np.linalg.svd(matrices[:, :3, :3], compute_uv=False)
    regular = (sizes[:, 2] > sizes[:, 0] * 1e-7) & (sizes[:, 2] > 1e-30)
    if not regular.all():
        raise reference.error(f"matrix {int(np.argmin(regular))} is singular, expected an invertible inverse bind")
    return matrices
