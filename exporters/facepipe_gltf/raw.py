"""A glTF file as it is, however wrong: JSON and decoded accessors for checks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import FacepipeError, InputError
from facepipe.records import Json
from facepipe.rig.trs import rotation_matrices
from facepipe_gltf.buffers import DRACO
from facepipe_gltf.read.accessors import Accessor, accessor, numbers
from facepipe_gltf.read.document import Document, Value, read_document

_FREE_NUMBERS, _NUMBERS_PER_BYTE = 1 << 29, 256  # that checks look at: these, and as many for each byte of the buffers


def as_object(value: object) -> Json:
    """A JSON object; an empty one in place of anything else."""
    return value if isinstance(value, dict) else {}


def as_list(value: object) -> list[Any]:
    """A JSON array; an empty one in place of anything else."""
    return value if isinstance(value, list) else []


class RawDocument:
    """The JSON of a .glb, .vrm or .gltf and its buffers.

    :raises InputError: not glTF at all: no such file, damaged container, no JSON object
    """

    def __init__(self, path: Path) -> None:
        self._take(read_document(path))

    @classmethod
    def from_json(cls, path: Path, document: Json, buffer: bytes) -> RawDocument:
        """A document that is not yet the file at `path`, and what its buffer 0 holds."""
        self = cls.__new__(cls)
        self._take(Document(root=Value(document, path.name, root=True), path=path, loaded={0: memoryview(buffer)}))
        self._document.budget.grant(len(buffer), 0)
        return self

    def _take(self, document: Document) -> None:
        self._document = document
        self.path, self.binary = document.path, document.binary
        self.json: Json = document.root.members()
        self._accessors: dict[str, Accessor] = {}  # by index
        self._items: dict[str, list[Json]] = {}
        self._looked = 0  # numbers of accessors, as often as they were asked for
        self.notes = tuple(document.warnings)  # on its container

    def items(self, name: str) -> list[Json]:
        """The objects of a top-level array; what is no object is an empty one."""
        if name not in self._items:
            self._items[name] = [as_object(one) for one in as_list(self.json.get(name))]
        return self._items[name]

    def item(self, name: str, index: object) -> Json | None:
        """One object of a top-level array; None where there is none of that index."""
        objects = self.items(name)
        return objects[index] if is_index(index) and index < len(objects) else None

    def accessor(self, index: object) -> FloatArray:
        """(count, width) float64 values, integers as they are unless normalised.

        :raises InputError: it is not there, or asks for bytes that its buffer doesn't have
        :raises FacepipeError: accessors of the same bytes come too often
        """
        checked = self._accessors.get(str(index))
        if checked is None:
            plain = self.unpacked.get(index, index) if is_index(index) else index
            if isinstance(plain, InputError):
                raise plain
            checked = accessor(self._document, Value(plain, self._document.root.trail))
            self._accessors[str(index)] = checked
        self._looked += checked.count * checked.components
        if self._looked > _FREE_NUMBERS + _NUMBERS_PER_BYTE * self._document.budget.held:
            raise FacepipeError(self.path.name, "more numbers to check than a file of its size can have")
        return numbers(self._document, checked)

    @cached_property
    def unpacked(self) -> dict[int, int | InputError]:
        """Accessors that Draco compressed -> the plain ones in their places, or why there are none."""
        result: dict[int, int | InputError] = {}
        for i, mesh in enumerate(self.items("meshes")):
            for j, one in enumerate(as_list(mesh.get("primitives"))):
                primitive = Value(one, f"{self._document.root.trail} -> meshes[{i}].primitives[{j}]")
                if DRACO not in as_object(as_object(one).get("extensions")):
                    continue
                from facepipe_gltf.read.draco import unpacked  # a module that exports do without

                packed = [one.get("indices"), *as_object(one.get("attributes")).values()]
                try:
                    plain = unpacked(self._document, primitive).members()
                    own: list[int | InputError] = [plain.get("indices", -1), *plain["attributes"].values()]
                except InputError as error:
                    own = [error] * len(packed)
                pairs = zip(packed, own, strict=True)
                result |= {old: new for old, new in pairs if is_index(old) and old != new}
        return result

    def maybe(self, index: object) -> FloatArray | None:
        """The accessor, or None where it can't be read (which the check of accessors reports)."""
        try:
            return self.accessor(index)
        except InputError:
            return None


def is_index(value: object) -> TypeGuard[int]:
    """Whether `value` is a JSON integer of 0 or more."""
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 1 << 53


def children(node: Json) -> list[int]:
    """Indices that a node names as its children."""
    return [one for one in as_list(node.get("children")) if is_index(one)]


def parents(document: RawDocument) -> dict[int, list[int]]:
    """Every node that is a child -> the nodes that name it."""
    above: dict[int, list[int]] = {}
    for i, node in enumerate(document.items("nodes")):
        for child in children(node):
            above.setdefault(child, []).append(i)
    return above


def path_above(node: int, above: Callable[[int], int | None]) -> list[int]:
    """A node and all above it, the root last; a cycle ends where it closes.

    :param above: the node that another hangs under; None for a root
    """
    path: dict[int, None] = {}
    one: int | None = node
    while one is not None and one not in path:
        path[one] = None
        one = above(one)
    return list(path)


def local_matrix(node: Json) -> FloatArray:
    """(4, 4) matrix of a node, column vectors; identity for what is no number."""
    matrix = _numbers(node.get("matrix"), 16)
    if matrix is not None:
        return np.asarray(matrix.reshape(4, 4).T)
    result = np.eye(4)
    rotation, scale = _numbers(node.get("rotation"), 4), _numbers(node.get("scale"), 3)
    if rotation is not None and rotation.any():
        result[:3, :3] = rotation_matrices(rotation)
    if scale is not None:
        result[:3, :3] *= scale
    translation = _numbers(node.get("translation"), 3)
    if translation is not None:
        result[:3, 3] = translation
    return result


def _numbers(value: Any, count: int) -> FloatArray | None:
    if not isinstance(value, list) or len(value) != count:
        return None
    if not all(isinstance(one, int | float) and abs(one) < 1e30 for one in value):
        return None
    return np.array(value, dtype=np.float64)


def world_matrices(document: RawDocument, nodes: Sequence[int]) -> list[FloatArray]:
    """(4, 4) world matrices of nodes at rest, each node computed once; a cycle ends where it closes."""
    above = parents(document)
    worlds: dict[int, FloatArray] = {}
    for node in nodes:
        path = path_above(node, lambda child: None if child in worlds else above.get(child, [None])[0])
        for one in reversed(path):
            if one not in worlds:
                parent = worlds.get(above.get(one, [-1])[0], np.eye(4))
                worlds[one] = parent @ local_matrix(document.item("nodes", one) or {})
    return [worlds[node] for node in nodes]
