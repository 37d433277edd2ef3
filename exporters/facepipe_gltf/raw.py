"""A glTF file as it is, however wrong: JSON, buffers and decoded accessors for checks."""

from __future__ import annotations

import base64
import binascii
import json
import struct
from pathlib import Path
from typing import Any, TypeGuard
from urllib.parse import unquote

import numpy as np
import numpy.typing as npt

from facepipe.core.errors import InputError
from facepipe.core.reading import check_values, read_bytes
from facepipe_gltf.read.meshopt import EXTENSION, decode

FloatArray = npt.NDArray[np.floating]
Json = dict[str, Any]

_GLB_MAGIC, _JSON_CHUNK, _BIN_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942
_TYPES = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_MOST_BYTES = 1 << 32  # of a file
_MOST_ZEROS = 1 << 23  # numbers of an accessor without data
_FREE_BYTES, _PER_BYTE = 1 << 26, 32  # of decoded views together: these, and as many for each byte of the buffers


class Broken(Exception):  # noqa: N818  (what a check reports, not what a user sees)
    """An accessor that can't be read, and why."""


class RawDocument:
    """The JSON of a .glb, .vrm or .gltf and its buffers.

    :raises InputError: not glTF at all: no such file, damaged container, no JSON object
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.binary: bytes | None = None
        data = read_bytes(path, _MOST_BYTES)
        text = self._container(data) if path.suffix.lower() in (".glb", ".vrm") else data
        check_values(path, text)
        try:
            parsed = json.loads(text.decode("utf-8-sig"))
        except (ValueError, RecursionError):
            raise InputError(path, "no readable JSON, expected a glTF document") from None
        if not isinstance(parsed, dict):
            raise InputError(path, "no JSON object, expected a glTF document")
        self.json: Json = parsed
        self._buffers: dict[int, bytes] = {}
        self._decoded: dict[int, bytes] = {}  # of compressed buffer views
        self._left = _FREE_BYTES

    @classmethod
    def of(cls, path: Path, document: Json, buffer: bytes) -> RawDocument:
        """A document that is not yet the file at `path`, and what its buffer 0 holds."""
        self = cls.__new__(cls)
        self.path, self.binary, self.json = path, None, document
        self._buffers, self._decoded, self._left = {0: buffer}, {}, _FREE_BYTES + _PER_BYTE * len(buffer)
        return self

    def _container(self, data: bytes) -> bytes:
        if len(data) < 20 or struct.unpack_from("<I", data)[0] != _GLB_MAGIC:
            raise InputError(self.path, "no GLB header, expected a binary glTF 2.0 file")
        _, version, length, size, kind = struct.unpack_from("<IIIII", data)
        if version != 2 or length != len(data) or kind != _JSON_CHUNK or 20 + size > len(data):
            what = f"version {version}, {length} bytes in its header and {len(data)} in the file"
            raise InputError(self.path, f"damaged GLB ({what}), expected version 2 with a JSON chunk first")
        at = 20 + size
        if at + 8 <= len(data):
            size_2, kind_2 = struct.unpack_from("<II", data, at)
            if kind_2 == _BIN_CHUNK:
                if at + 8 + size_2 > len(data):
                    raise InputError(self.path, "damaged GLB: the binary chunk ends beyond the file")
                self.binary = data[at + 8 : at + 8 + size_2]
        return data[20 : 20 + size]

    def items(self, name: str) -> list[Json]:
        """The objects of a top-level array; what is no object is an empty one."""
        found = self.json.get(name)
        return [one if isinstance(one, dict) else {} for one in found] if isinstance(found, list) else []

    def item(self, name: str, index: object) -> Json | None:
        """One object of a top-level array; None where there is none of that index."""
        found = self.json.get(name)
        if not isinstance(found, list) or not is_index(index) or index >= len(found):
            return None
        return found[index] if isinstance(found[index], dict) else {}

    def accessor(self, index: object) -> FloatArray:
        """(count, width) float64 values, integers as they are unless normalised.

        :raises Broken: it is not there, or asks for bytes that its buffer doesn't have
        """
        accessor = self.item("accessors", index)
        if accessor is None:
            raise Broken(f"accessor {index} is not there")
        width, dtype = _WIDTHS.get(str(accessor.get("type"))), _component(accessor)
        count = accessor.get("count")
        if width is None or dtype is None or not is_index(count) or count < 1:
            raise Broken("type, componentType or count is wrong")
        if "bufferView" in accessor:
            values = self._view(accessor["bufferView"], accessor.get("byteOffset", 0), count, width, dtype)
        elif count * width > _MOST_ZEROS:
            raise Broken(f"count {count} without data is beyond what a face can need")
        else:
            values = np.zeros((count, width))
        if "sparse" in accessor:
            self._sparse(accessor["sparse"], values, width, dtype)
        return normalised(values, dtype) if accessor.get("normalized") is True else values

    def maybe(self, index: object) -> FloatArray | None:
        """The accessor, or None where it can't be read (which the check of accessors reports)."""
        try:
            return self.accessor(index)
        except Broken:
            return None

    def _sparse(self, sparse: Any, values: FloatArray, width: int, dtype: Any) -> None:
        indices, own = (sparse.get(name) if isinstance(sparse, dict) else None for name in ("indices", "values"))
        count = sparse.get("count") if isinstance(sparse, dict) else None
        if not isinstance(indices, dict) or not isinstance(own, dict) or not is_index(count):
            raise Broken("sparse has no count, indices or values")
        kind = _component(indices)
        if kind not in (np.uint8, np.uint16, np.uint32):
            raise Broken("sparse indices have a wrong componentType")
        where = self._view(indices.get("bufferView"), indices.get("byteOffset", 0), count, 1, kind)[:, 0]
        if len(where) and (where.max() >= len(values) or (np.diff(where) <= 0).any()):
            raise Broken(f"sparse indices are not ascending in 0 to {len(values) - 1}")
        given = self._view(own.get("bufferView"), own.get("byteOffset", 0), count, width, dtype)
        values[where.astype(np.int64)] = given

    def _view(self, index: object, offset: object, count: int, width: int, dtype: Any) -> FloatArray:
        view = self.item("bufferViews", index)
        if view is None:
            raise Broken(f"bufferView {index} is not there")
        start, length = view.get("byteOffset", 0), view.get("byteLength")
        compressed = self._compressed(index, view)
        buffer = self._buffer(view.get("buffer")) if compressed is None else compressed
        start = start if compressed is None else 0
        element = width * np.dtype(dtype).itemsize
        stride = view.get("byteStride", element)
        if not (is_index(start) and is_index(length) and is_index(offset) and is_index(stride)) or stride < element:
            raise Broken("byteOffset, byteLength or byteStride of the bufferView is wrong")
        needed = offset + stride * (count - 1) + element if count else 0
        if needed > length or start + length > len(buffer):
            have = min(length, max(len(buffer) - start, 0))
            raise Broken(f"asks for {needed} bytes of a bufferView with {have}")
        raw = np.frombuffer(buffer, np.uint8, needed - offset, start + offset) if count else np.zeros(0, np.uint8)
        rows = np.lib.stride_tricks.as_strided(raw, (count, element), (stride, 1))
        decoded: FloatArray = np.ascontiguousarray(rows).view(np.dtype(dtype).newbyteorder("<")).astype(np.float64)
        return decoded

    def _compressed(self, index: object, view: Json) -> bytes | None:
        """What a buffer view of compressed data holds; None where its data is as it is."""
        extensions = view.get("extensions")
        own = extensions.get(EXTENSION) if isinstance(extensions, dict) else None
        if not isinstance(own, dict) or not is_index(index):
            return None
        if index not in self._decoded:
            buffer, start, length = self._buffer(own.get("buffer")), own.get("byteOffset", 0), own.get("byteLength")
            count, size = own.get("count"), own.get("byteStride")
            if not (is_index(start) and is_index(length) and is_index(count) and is_index(size)):
                raise Broken(f"byteOffset, byteLength, count or byteStride of {EXTENSION} is wrong")
            self._left -= count * size
            if self._left < 0:
                raise Broken(f"bufferView {index} asks for far more data than the file holds")
            try:
                data = bytes(buffer[start : start + length])
                self._decoded[index] = decode(data, count, size, str(own.get("mode")), str(own.get("filter", "NONE")))
            except ValueError as error:
                raise Broken(f"bufferView {index} can't be decoded: {error}") from None
        return self._decoded[index]

    def _buffer(self, index: object) -> bytes:
        buffer = self.item("buffers", index)
        if buffer is None:
            raise Broken(f"buffer {index} is not there")
        number = index if is_index(index) else 0
        if number not in self._buffers:
            self._buffers[number] = self._load(buffer, number)
            self._left += _PER_BYTE * len(self._buffers[number])
        return self._buffers[number]

    def _load(self, buffer: Json, number: int) -> bytes:
        uri = buffer.get("uri")
        if uri is None:
            if number == 0 and self.binary is not None:
                return self.binary
            raise Broken(f"buffer {number} has no uri and no binary chunk")
        text = str(uri)
        if text.startswith("data:"):
            try:
                return base64.b64decode(text.partition(",")[2], validate=True)
            except (binascii.Error, ValueError):
                raise Broken(f"buffer {number} has a damaged data uri") from None
        file = Path(unquote(text))
        if "://" in text or file.is_absolute() or ".." in file.parts:
            raise Broken(f"buffer {number} names '{text[:60]}', expected a file below the folder of the glTF file")
        try:
            return read_bytes(self.path.parent / file, _MOST_BYTES)
        except InputError:
            raise Broken(f"buffer {number} names '{text[:60]}', which can't be read") from None


def _component(accessor: Json) -> Any:
    kind = accessor.get("componentType")
    return _TYPES.get(kind) if is_index(kind) else None


def is_index(value: object) -> TypeGuard[int]:
    """Whether `value` is a JSON integer of 0 or more."""
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 1 << 53


def normalised(values: FloatArray, dtype: Any) -> FloatArray:
    """Integers as the fractions they stand for (glTF 2.0, section 3.11)."""
    if np.dtype(dtype).kind == "f":
        return values
    return np.asarray(np.maximum(values / np.iinfo(dtype).max, -1.0))
