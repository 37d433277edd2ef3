"""The node hierarchy: local and world matrices, and which nodes the scene shows.

Source: glTF 2.0 section 3.5.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.parts import FloatArray, identity
from facepipe_gltf.read.document import Document
from facepipe_gltf.read.values import Value, members


@dataclass(frozen=True)
class Trs:
    """A node's translation (3,), rotation x y z w (4,) and scale (3,)."""

    translation: FloatArray
    rotation: FloatArray
    scale: FloatArray


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
    children = [[document.index("nodes", child) for child in members(value.get("children"))] for value in values]
    parents = _parents(values, children)
    roots = [node for node, parent in enumerate(parents) if parent < 0]
    order = _depth_first(roots, children)
    if len(order) < len(values):
        lost = sorted(set(range(len(values))) - set(order))[0]
        raise values[lost].error("is its own ancestor, expected a tree")
    locals_ = np.array([local_matrix(value) for value in values]).reshape(-1, 4, 4)
    worlds = _worlds(locals_, parents, order)
    finite = np.isfinite(worlds).all(axis=(1, 2))
    if not finite.all():
        raise values[int(np.argmin(finite))].error("its world transform is not finite")
    shown = _depth_first(_scene_roots(document, scene, roots, parents), children)
    return Nodes(values, parents, order, locals_, worlds, shown)


def trs_matrix(translation: FloatArray, rotation: FloatArray, scale: FloatArray) -> FloatArray:
    """(..., 4, 4) of translation (..., 3), unit rotation x y z w (..., 4) and scale (..., 3)."""
    x, y, z, w = np.moveaxis(np.asarray(rotation, np.float64), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    result = np.zeros((*x.shape, 4, 4))
    result[..., :3, :3] = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2) * scale[..., None, :]
    result[..., :3, 3] = translation
    result[..., 3, 3] = 1.0
    return result


def decompose(matrices: FloatArray) -> tuple[Trs, float]:
    """Translations, rotations and scales of (..., 4, 4), and the largest part that is lost as shear."""
    linear = matrices[..., :3, :3]
    scale = np.linalg.norm(linear, axis=-2)
    scale = np.where(np.linalg.det(linear)[..., None] < 0.0, -scale, scale)
    rotation = linear / np.where(scale == 0.0, 1.0, scale)[..., None, :]
    quaternion = _quaternions(rotation)
    translation = matrices[..., :3, 3]
    rebuilt = trs_matrix(translation, quaternion, scale)
    return Trs(translation, quaternion, scale), float(np.abs(rebuilt - matrices).max(initial=0.0))


def local_trs(value: Value) -> Trs:
    """A node's translation, rotation and scale; a matrix is taken apart."""
    matrix = value.get("matrix")
    if matrix is not None:
        return decompose(_matrix(matrix))[0]
    translation, rotation, scale = value.get("translation"), value.get("rotation"), value.get("scale")
    quaternion = np.array([0.0, 0.0, 0.0, 1.0] if rotation is None else rotation.numbers(4))
    length = float(np.linalg.norm(quaternion))
    if rotation is not None and not 1e-6 < length < 1e6:
        raise rotation.error("a quaternion without a usable length, expected a unit quaternion")
    return Trs(
        np.array(translation.numbers(3) if translation is not None else (0.0, 0.0, 0.0)),
        quaternion if abs(length - 1.0) < 1e-12 else quaternion / length,
        np.array(scale.numbers(3) if scale is not None else (1.0, 1.0, 1.0)),
    )


def local_matrix(value: Value) -> FloatArray:
    """(4, 4) of a node, from its matrix or from translation, rotation and scale."""
    matrix = value.get("matrix")
    if matrix is not None:
        return _matrix(matrix)
    if not {"translation", "rotation", "scale"} & set(value.member_names()):
        return identity()
    trs = local_trs(value)
    return trs_matrix(trs.translation, trs.rotation, trs.scale)


def _matrix(value: Value) -> FloatArray:
    matrix = np.array(value.numbers(16)).reshape(4, 4).T
    if np.abs(matrix[3] - (0.0, 0.0, 0.0, 1.0)).max() > 1e-6:
        raise value.error("its last row is not 0 0 0 1")
    matrix[3] = (0.0, 0.0, 0.0, 1.0)
    return matrix


def _parents(values: list[Value], children: list[list[int]]) -> list[int]:
    parents = [-1] * len(values)
    for node, below in enumerate(children):
        for child in below:
            if parents[child] >= 0:
                raise values[child].error(
                    f"is a child of nodes[{parents[child]}] and nodes[{node}], expected one parent"
                )
            parents[child] = node
    return parents


def _depth_first(roots: list[int], children: list[list[int]]) -> list[int]:
    order: list[int] = []
    stack = list(reversed(roots))
    while stack:
        node = stack.pop()
        order.append(node)
        stack.extend(reversed(children[node]))
    return order


def _worlds(locals_: FloatArray, parents: list[int], order: list[int]) -> FloatArray:
    worlds = np.array(locals_)
    for node in order:
        if parents[node] >= 0:
            worlds[node] = worlds[parents[node]] @ locals_[node]
    return worlds


def _scene_roots(document: Document, scene: int | None, roots: list[int], parents: list[int]) -> list[int]:
    scenes = document.entries("scenes")
    if scene is not None and not 0 <= scene < len(scenes):
        raise document.root.error(f"scene {scene}, but there are {len(scenes)}")
    default = document.root.get("scene")
    if default is not None:
        document.index("scenes", default)
    if not scenes:
        return roots
    chosen = scene if scene is not None else (default.integer() if default is not None else 0)
    found: dict[int, None] = {}
    for reference in members(scenes[chosen].get("nodes")):
        node = document.index("nodes", reference)
        if parents[node] >= 0 or node in found:
            raise reference.error(f"nodes[{node}] is not a root or is listed twice")
        found[node] = None
    return list(found)


def _quaternions(rotation: FloatArray) -> FloatArray:
    """(..., 4) x y z w of rotation matrices, by the largest of the four squared components (Shepperd 1978)."""
    m = rotation
    trace = m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2]
    squares = np.stack([2 * m[..., 0, 0] - trace, 2 * m[..., 1, 1] - trace, 2 * m[..., 2, 2] - trace, trace], axis=-1)
    xy, yz, zx = m[..., 1, 0] + m[..., 0, 1], m[..., 2, 1] + m[..., 1, 2], m[..., 0, 2] + m[..., 2, 0]
    x, y, z = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    one = 1.0 + squares
    rows = np.stack(
        [
            np.stack([one[..., 0], xy, zx, x], axis=-1),
            np.stack([xy, one[..., 1], yz, y], axis=-1),
            np.stack([zx, yz, one[..., 2], z], axis=-1),
            np.stack([x, y, z, one[..., 3]], axis=-1),
        ],
        axis=-2,
    )
    best = np.argmax(squares, axis=-1)
    chosen = np.take_along_axis(rows, best[..., None, None], axis=-2)[..., 0, :]
    length = np.linalg.norm(chosen, axis=-1, keepdims=True)
    return np.asarray(chosen / np.where(length == 0.0, 1.0, length))
