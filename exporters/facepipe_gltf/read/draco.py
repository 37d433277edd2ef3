"""What KHR_draco_mesh_compression has compressed, decoded by Draco's own decoder in WebAssembly.

Source: the glTF extension KHR_draco_mesh_compression.
"""

from __future__ import annotations

import atexit
import functools
from pathlib import Path
from typing import Any

import numpy as np

from facepipe.core.errors import InputError
from facepipe.core.webassembly import MOST_BYTES, Program, Run
from facepipe_gltf.buffers import DRACO, MESHOPT
from facepipe_gltf.read.accessors import element
from facepipe_gltf.read.document import Document, Value

_MODULE = Path(__file__).with_name("draco_decoder.wasm")
EXPORTS = {  # of draco_decoder_gltf.wasm in draco3dgltf 1.5.7, whose script calls them by these names
    "__wasm_call_ctors": "f",
    "_malloc": "Qb",
    "_emscripten_bind_Decoder_Decoder_0": "Ja",
    "_emscripten_bind_Decoder_DecodeArrayToMesh_3": "La",
    "_emscripten_bind_Decoder_GetAttributeByUniqueId_2": "Qa",
    "_emscripten_bind_Decoder_GetTrianglesUInt32Array_3": "Wa",
    "_emscripten_bind_Decoder_GetAttributeDataArrayForAllPoints_5": "eb",
    "_emscripten_bind_Mesh_Mesh_0": "P",
    "_emscripten_bind_Mesh_num_faces_0": "Q",
    "_emscripten_bind_Mesh_num_points_0": "S",
    "_emscripten_bind_PointAttribute_num_components_0": "v",
    "_emscripten_bind_Status_ok_0": "X",
    "_emscripten_bind_Status_error_msg_0": "Y",
}
_MEMORY, _PAGE = "e", 1 << 16
_KINDS = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "u4": 6, "f4": 9}  # draco::DataType of a component
_LONGEST_MESSAGE = 80
_DENSER = 8  # times as much as plain data that a byte may unfold to: smooth surfaces take one to three a vertex
_FREE_BYTES = 1 << 26  # of the decoder's memory, and as many as the document may still unfold to
_START_BYTES = 1 << 16  # that a primitive costs beside its data
_STEPS_PER_BYTE = 64  # of the decoder that count as one: edgebreaker takes some 23,000 a vertex


@functools.cache
def _program() -> Program:
    return Program(_MODULE, "draco", bounded=True)


atexit.register(_program.cache_clear)  # wasmtime can't free what is left once Python takes its modules down


def unpacked(document: Document, primitive: Value) -> Value:
    """A primitive with what Draco compressed of it as plain accessors; itself where that is nothing.

    Where the extension is not required and the file has the same uncompressed, that is read: it is exact.

    :raises InputError: data that Draco can't decode, or that is not what the accessors say; wasmtime is not there
    """
    packed = primitive.extension(DRACO)
    if packed is None or _is_plain_too(document, primitive, packed):
        return primitive
    if primitive.trail not in document.unpacked:
        document.unpacked[primitive.trail] = _unpacked(document, primitive, packed)
    return document.unpacked[primitive.trail]


def _is_plain_too(document: Document, primitive: Value, packed: Value) -> bool:
    if any(one.data == DRACO for one in document.root.get_or("extensionsRequired", []).items()):
        return False
    attributes = primitive.require("attributes")
    used = [attributes.get(name) for name in packed.require("attributes").member_names()]
    entries = [document.entry("accessors", one) for one in (*used, primitive.get("indices")) if one is not None]
    return all(entry.get("bufferView") is not None for entry in entries)


def _unpacked(document: Document, primitive: Value, packed: Value) -> Value:
    attributes, numbers = primitive.require("attributes"), packed.require("attributes")
    entries = {
        name: document.entry("accessors", reference)
        for name in numbers.member_names()
        if (reference := attributes.get(name)) is not None
    }
    for name in attributes.member_names():
        plain = document.entry("accessors", attributes.require(name))
        if name not in entries and plain.get("bufferView") is None and plain.get("sparse") is None:
            raise packed.error(f"no {ascii(name)[:40]} in its attributes, and its accessor has no data")
    elements = {name: element(entry) for name, entry in entries.items()}
    data = _data(document, packed)
    document.budget.spend(_START_BYTES, packed.error)
    left = document.budget.left
    try:
        decoder = _Decoder(data, min(MOST_BYTES, _FREE_BYTES + left), _STEPS_PER_BYTE * left)
        points, corners = decoder.points, 3 * decoder.faces
        size = points * sum(dtype.itemsize * components for dtype, components in elements.values()) + 4 * corners
        document.budget.spend(size, packed.error)
        values = {name: decoder.values(numbers.require(name).integer(), *elements[name]) for name in entries}
        triangles = decoder.triangles()
    except InputError as error:
        if error.where != _MODULE.stem:
            raise
        raise packed.error(f"can't be decoded: {error.what}") from None
    document.budget.spend(decoder.steps // _STEPS_PER_BYTE, packed.error)
    counts = {name: entry.require("count").integer() for name, entry in entries.items()}
    if told := sorted({*counts.values()} - {points}):
        document.warn(packed, f"holds {points} vertices, its accessors say {', '.join(map(str, told[:3]))}")
    own = {name: document.add_accessor(entry, points, values[name]) for name, entry in entries.items()}
    listed = Value({"componentType": 5125, "type": "SCALAR"}, packed.trail)
    indices = document.add_accessor(listed, corners, triangles)
    members = {"attributes": {**attributes.members(), **own}, "indices": indices, "mode": 4}
    return Value({**primitive.members(), **members}, primitive.trail)


def _data(document: Document, packed: Value) -> bytes:
    """The bytes of a primitive; what its buffer may unfold to grows."""
    reference = packed.require("bufferView")
    view = document.entry("bufferViews", reference)
    if view.extension(MESHOPT) is not None:
        raise view.error(f"{MESHOPT} under {DRACO}, expected one of them")
    data, start, length = document.view(reference)
    document.budget.grant(_DENSER * len(data), (DRACO, document.index("buffers", view.require("buffer"))))
    return bytes(data[start : start + length])


class _Decoder(Run):
    """Draco's decoder with one mesh decoded."""

    def __init__(self, data: bytes, most_bytes: int, most_steps: int) -> None:
        """:raises InputError: no mesh that Draco can decode in these bounds"""
        imports = (_abort, _throw, _grow, _copy)
        super().__init__(_program(), _MEMORY, most_bytes=most_bytes, most_steps=most_steps, imports=imports)
        self._call("__wasm_call_ctors")
        address = self._call("_malloc", len(data))
        self.write(address, data)
        self._decoder = self._call("_emscripten_bind_Decoder_Decoder_0")
        self._mesh = self._call("_emscripten_bind_Mesh_Mesh_0")
        decode = "_emscripten_bind_Decoder_DecodeArrayToMesh_3"
        status = self._call(decode, self._decoder, address, len(data), self._mesh)
        if not self._call("_emscripten_bind_Status_ok_0", status):
            said = self.read(self._call("_emscripten_bind_Status_error_msg_0", status), _LONGEST_MESSAGE)
            raise InputError(_MODULE.stem, said.partition(b"\0")[0].decode("ascii", "replace"))
        self.points = self._call("_emscripten_bind_Mesh_num_points_0", self._mesh)
        self.faces = self._call("_emscripten_bind_Mesh_num_faces_0", self._mesh)
        if self.points < 1 or self.faces < 1:
            raise InputError(_MODULE.stem, f"{self.faces} triangles of {self.points} vertices, expected some")

    def values(self, number: int, dtype: np.dtype[np.generic], components: int) -> bytes:
        """The values of an attribute at all vertices.

        :param number: Draco's unique number of the attribute
        :raises InputError: no such attribute, or one with other components
        """
        find, count = "GetAttributeByUniqueId_2", "_emscripten_bind_PointAttribute_num_components_0"
        known = number < 1 << 31  # a larger one would be taken for another
        attribute = known and self._call(f"_emscripten_bind_Decoder_{find}", self._decoder, self._mesh, number)
        found = self._call(count, attribute) if attribute else 0
        if found != components:
            raise InputError(_MODULE.stem, f"attribute {number} has {found} components, expected {components}")
        size = self.points * components * dtype.itemsize
        get = "_emscripten_bind_Decoder_GetAttributeDataArrayForAllPoints_5"
        return self._array(get, attribute, _KINDS[dtype.str[1:]], size=size)

    def triangles(self) -> bytes:
        """The corners of all triangles, 4 bytes each."""
        return self._array("_emscripten_bind_Decoder_GetTrianglesUInt32Array_3", size=12 * self.faces)

    def _array(self, name: str, *arguments: int, size: int) -> bytes:
        address = self._call("_malloc", size)
        if not self._call(name, self._decoder, self._mesh, *arguments, size, address):
            raise InputError(_MODULE.stem, "values that do not fit their accessor")
        return self.read(address, size)

    def _call(self, name: str, *arguments: int) -> int:
        return self.call(EXPORTS[name], *arguments)


# what the module calls, as the script of its package has it: an abort, an exception, memory that grows, a long copy


def _abort(caller: Any) -> None:
    raise ValueError("it asks for far more memory than its size allows")


def _throw(caller: Any, exception: int, kind: int, destructor: int) -> None:
    raise ValueError("it asks for far more memory than its size allows")


def _grow(caller: Any, size: int) -> int:
    """Whether the memory grew to `size` bytes."""
    memory = caller[_MEMORY]
    missing = (size & 0xFFFFFFFF) - memory.data_len(caller)
    try:
        memory.grow(caller, -(-missing // _PAGE))
    except Exception:  # wasmtime's own, which is not to be imported here
        return 0
    return 1


def _copy(caller: Any, target: int, source: int, size: int) -> None:
    memory = caller[_MEMORY]
    if min(target, source, size) < 0 or max(target, source) + size > memory.data_len(caller):
        raise ValueError("out of bounds memory access")
    memory.write(caller, memory.read(caller, source, source + size), target)
