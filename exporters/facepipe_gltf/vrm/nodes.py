"""The node tree of a document in the making: nodes are added and get other parents, meshes stay in place."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.records import Json
from facepipe.rig.trs import decompose
from facepipe_gltf.placement import numbers
from facepipe_gltf.raw import local_matrix, path_above


class NodeTree:
    """The nodes of a document's only scene."""

    def __init__(self, document: Json) -> None:
        self.nodes: list[Json] = document.setdefault("nodes", [])
        self.roots: list[int] = document["scenes"][0].setdefault("nodes", [])
        self._parent = {child: i for i, node in enumerate(self.nodes) for child in node.get("children", [])}
        self._names = {node.get("name") for node in self.nodes}

    def path(self, node: int) -> list[int]:
        """The node and all above it, the root last."""
        return path_above(node, self._parent.get)

    def world(self, node: int) -> FloatArray:
        """(4, 4) world matrix at rest."""
        result = np.eye(4)
        for one in self.path(node):
            result = local_matrix(self.nodes[one]) @ result
        return result

    def add(self, name: str, place: FloatArray, parent: int | None) -> int:
        """A node at a `place` (3,) of the world, turned as its parent is; its number."""
        while name in self._names:
            name += "_"
        self._names.add(name)
        self.nodes.append({"name": name})
        number = len(self.nodes) - 1
        self._put(number, parent)
        above = np.eye(4) if parent is None else self.world(parent)
        self._translate(number, (np.linalg.inv(above) @ [*place, 1.0])[:3])
        return number

    def hang(self, node: int, under: int) -> None:
        """Hang a node under another that is turned as the one above it was: its translation alone changes."""
        offset = (np.linalg.inv(self.world(under)) @ self.world(node))[:3, 3]
        self._take(node)
        self._put(node, under)
        self._translate(node, offset)

    def hang_mesh(self, node: int, under: int) -> None:
        """Hang the node of a mesh, at the scene's root without a transform, under another."""
        local = decompose(np.linalg.inv(self.world(under))[None])
        self._take(node)
        self._put(node, under)
        self._translate(node, local.translation[0])
        for key, values, plain in (("rotation", local.rotation, [0, 0, 0, 1]), ("scale", local.scale, [1, 1, 1])):
            if numbers(values[0]) != plain:
                self.nodes[node][key] = numbers(values[0])

    def _take(self, node: int) -> None:
        parent = self._parent.pop(node, None)
        siblings = self.roots if parent is None else self.nodes[parent]["children"]
        siblings.remove(node)
        if parent is not None and not siblings:
            del self.nodes[parent]["children"]

    def _put(self, node: int, under: int | None) -> None:
        if under is None:
            self.roots.append(node)
        else:
            self._parent[node] = under
            self.nodes[under].setdefault("children", []).append(node)

    def _translate(self, node: int, offset: FloatArray) -> None:
        self.nodes[node].pop("translation", None)
        if np.any(offset):
            self.nodes[node]["translation"] = numbers(offset)
