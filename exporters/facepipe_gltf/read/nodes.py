"""The node hierarchy: local and world matrices, and which nodes the scene shows.

Source: glTF 2.0 section 3.5.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.parts import identity
from facepipe.rig.trs import compose, decompose
from facepipe_gltf.read.document import Document
from facepipe_gltf.read.values import Value


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
    parents = _parents(values, children)
    roots = [node for node, parent in enumerate(parents) if parent < 0]
    order = _depth_first(roots, children)
    # a cycle has no root: no walk from one comes there
    if len(order) < len(values):
        lost = sorted(set(range(len(values))) - set(order))[0]
        raise values[lost].error("is its own ancestor, expected a tree")
    locals_ = np.array([_local_matrix(value) for value in values]).reshape(-1, 4, 4)
    worlds = np.array(locals_)
    for node in order:
        if parents[node] >= 0:
            worlds[node] = worlds[parents[node]] @ locals_[node]
    # finite local matrices are not enough: products of large scales overflow
    finite = np.isfinite(worlds).all(axis=(1, 2))
    if not finite.all():
        raise values[int(np.argmin(finite))].error("its world transform is not finite")
    shown = _depth_first(_scene_roots(document, scene, roots, parents), children)
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


def _local_matrix(value: Value) -> FloatArray:
    """(4, 4) of a node, from its matrix or from translation, rotation and scale."""
    matrix = value.get("matrix")
    if matrix is not None:
        return _matrix(matrix)
    if not {"translation", "rotation", "scale"} & set(value.member_names()):
        return identity()
    return compose(*local_trs(value))


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
    listed: dict[int, None] = {}
    for reference in scenes[chosen].get_or("nodes", []).items():
        node = document.index("nodes", reference)
        if parents[node] >= 0 or node in listed:
            raise reference.error(f"nodes[{node}] is not a root or is listed twice")
        listed[node] = None
    return list(listed)
