"""The skeleton as glTF nodes and a skin."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.parts import Skeleton
from facepipe.records import Json
from facepipe.rig.trs import Trs, accumulate, decompose
from facepipe_gltf.placement import Space, numbers

_INHERITED_SHEAR_TOLERANCE = 1e-4
_UNEVEN = 1e-5  # of scales along the axes of a joint


@dataclass(frozen=True)
class JointNodes:
    """The nodes of a skeleton.

    A joint whose rest transform is sheared, or a root under a scaled or mirrored placement, gets a node above it that
    takes what no TRS can hold: `offsets` takes it off that joint's local matrices, and is the identity for all others.
    """

    nodes: list[Json]
    roots: list[int]  # node indices at the top
    of_joint: list[int]  # node index of each joint
    offsets: FloatArray  # (j, 4, 4) inverse of the node above each joint that is no joint
    rest: Trs  # of the joints' own nodes
    warnings: list[str]


def joint_nodes(skeleton: Skeleton, space: Space, first: int, *, person: bool = False) -> JointNodes:
    """Nodes numbered from `first`, joints in skeleton order, each at rest.

    :param person: rest is a person: uneven scales go to a node above too, since a joint that turns under them is no TRS
    """
    parents = skeleton.parents
    local = space.local(np.asarray(skeleton.rest_transforms, dtype=np.float64), parents < 0)
    unholdable = _unholdable(skeleton, space, local, person)
    above = np.tile(np.eye(4), (len(local), 1, 1))
    for joint, matrix in unholdable.items():
        above[joint] = _parent(matrix)
    offsets = np.linalg.inv(above)
    # an animated node is TRS and holds no shear: a node above takes that, and offsets take it out again
    rest = decompose(offsets @ local)
    names = _node_names(skeleton)
    nodes = [_node(name, rest, i) for i, name in enumerate(names)]
    top = list(range(first, first + len(nodes)))  # node that stands for each joint among its siblings
    for joint in unholdable:
        top[joint] = first + len(nodes)
        helper = _node(f"{names[joint]}_parent", decompose(above[joint][None]), 0)
        nodes.append(helper | {"children": [first + joint]})
    for joint, parent in enumerate(parents):
        if parent >= 0:
            nodes[parent].setdefault("children", []).append(top[joint])
    roots = [top[joint] for joint in np.flatnonzero(parents < 0)]
    if len(roots) > 1:  # joints of one skin need a common root
        nodes.append({"name": skeleton.name, "children": roots})
        roots = [first + len(nodes) - 1]
    warnings = _warnings(skeleton, [] if person else list(unholdable), rest, accumulate(local, parents))
    return JointNodes(nodes, roots, list(range(first, first + len(local))), offsets, rest, warnings)


def _node_names(skeleton: Skeleton) -> list[str]:
    """The joints' names in the source; else the last part of each path, or the whole path where that is ambiguous."""
    if skeleton.joint_names:
        return list(skeleton.joint_names)
    times = Counter(skeleton.names)
    pairs = zip(skeleton.names, skeleton.joints, strict=True)
    return [leaf if times[leaf] == 1 else joint.replace("/", "_") for leaf, joint in pairs]


def has_shear(worlds: FloatArray) -> FloatArray:
    """(...,) whether the axes of (..., 4, 4) matrices are not at right angles."""
    linear = worlds[..., :3, :3]
    length = np.linalg.norm(linear, axis=-2, keepdims=True)
    axes = linear / np.where(length == 0, 1.0, length)
    gram = np.abs(np.swapaxes(axes, -1, -2) @ axes) * (1 - np.eye(3))
    return np.asarray(gram.max(axis=(-1, -2)) > _INHERITED_SHEAR_TOLERANCE)


def _unholdable(skeleton: Skeleton, space: Space, local: FloatArray, person: bool) -> dict[int, FloatArray]:
    """Joints that need a node above them, with the matrix that it must take."""
    turned = space.local(np.asarray(skeleton.rest_transforms, dtype=np.float64), np.zeros(len(local), np.bool_))
    at_rest = decompose(turned)
    sizes = np.abs(at_rest.scale)
    uneven = np.ptp(sizes, axis=-1) > _UNEVEN * sizes.max(axis=-1)
    linear = space.placement[:3, :3]
    rigid = np.allclose(linear.T @ linear, np.eye(3), rtol=0, atol=1e-9) and np.linalg.det(linear) > 0
    result = {}
    for joint, parent in enumerate(skeleton.parents):
        if at_rest.sheared[joint] or (person and uneven[joint]):
            result[joint] = local[joint]
        elif parent < 0 and not rigid:
            result[joint] = space.placement
    return result


def _parent(matrix: FloatArray) -> FloatArray:
    """T U S of ``matrix = T U S V``: what is left of it is the rotation V, so both are TRS."""
    U, scale, Vt = np.linalg.svd(matrix[:3, :3])
    if np.linalg.det(Vt) < 0:
        U, Vt = -U, -Vt
    parent = np.eye(4)
    parent[:3, :3] = U * scale
    parent[:3, 3] = matrix[:3, 3]
    return parent


def _node(name: str, trs: Trs, i: int) -> Json:
    node: Json = {"name": name}
    if trs.translation[i].any():
        node["translation"] = numbers(trs.translation[i])
    rotation = numbers(trs.rotation[i])
    if rotation != [0.0, 0.0, 0.0, 1.0]:
        node["rotation"] = rotation
    scale = numbers(trs.scale[i])
    if scale != [1.0, 1.0, 1.0]:
        node["scale"] = scale
    return node


def _warnings(skeleton: Skeleton, helped: list[int], rest: Trs, worlds: FloatArray) -> list[str]:
    warnings = [f"{skeleton.joints[joint]}: sheared at rest, held by an extra node above" for joint in helped]
    mirrored = np.flatnonzero((rest.scale < 0).any(axis=-1))
    warnings += [f"{skeleton.joints[joint]}: negative scale at rest; not every engine keeps it" for joint in mirrored]
    inherited = np.flatnonzero(has_shear(worlds))
    if len(inherited):
        example = skeleton.joints[inherited[0]]
        warnings.append(
            f"{example}: shear inherited from scaled parents ({len(inherited)} joints); not every engine keeps it"
        )
    return warnings
