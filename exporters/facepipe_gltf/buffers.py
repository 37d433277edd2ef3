"""The binary side of a glTF document: accessors, buffer views and the buffer."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from facepipe.core.errors import ExportError
from facepipe.records import Json

Array = npt.NDArray[Any]
Chunk = bytes | memoryview
Use = Literal["vertex", "index", "matrices", "keys"]

_COMPONENT = {"b": 5120, "B": 5121, "h": 5122, "H": 5123, "I": 5125, "L": 5125, "f": 5126}
_TYPE = {(): "SCALAR", (2,): "VEC2", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}
_TARGET = {"vertex": 34962, "index": 34963}
_ALIGNMENT = 4


class Extent(NamedTuple):
    """Smallest and largest value per axis."""

    low: list[float]
    high: list[float]


class Rows(NamedTuple):
    """One attribute of one target of a primitive: zero but at some vertices."""

    vertices: Array  # (k,) ascending
    values: Array  # (k, 3)
    extent: Extent  # of all vertices, those that stay zero too
    normalized: bool


class _Key(NamedTuple):
    """Accessors share a buffer view when they agree on these."""

    use: str
    stride: int
    label: str


@dataclass
class _View:
    number: int
    chunks: list[Chunk] = field(default_factory=list)
    size: int = 0

    def append(self, data: Chunk) -> int:
        """Add `data`, aligned; its offset in the view."""
        offset = self.size
        padding = -len(data) % _ALIGNMENT
        self.chunks.append(data)
        if padding:
            self.chunks.append(bytes(padding))
        self.size += len(data) + padding
        return offset


_SPARSE = _Key("sparse", 0, "")


class Buffers:
    """Collects arrays into few buffer views: one per use and stride, so that the JSON stays small.

    MAT4 arrays are expected in the column-vector convention and stored column-major, as glTF wants them.
    """

    def __init__(self, *, dense: bool = False, apart: bool = False) -> None:
        self._dense = dense  # no sparse accessors
        self._apart = apart  # each list of indices in a view of its own
        self.accessors: list[Json] = []
        self.sparse_count = 0
        self._views: dict[_Key, _View] = {}
        self._zeros: dict[tuple[int, int, str], int] = {}

    def add(self, array: Array, use: Use, *, normalized: bool = False, bounds: bool = False) -> int:
        """A dense accessor over all of `array`, which must not change any more; its index.

        :raises ExportError: numbers that left the range of float32 on their way to metres
        """
        require_finite(array)
        extent = None
        if bounds:
            columns = array.reshape(len(array), -1).T  # one pass a column: numpy is slow along a short last axis
            extent = Extent([column.min().item() for column in columns], [column.max().item() for column in columns])
        return self._add_dense(array, use, normalized, extent)

    def add_morph(self, rows: Rows, count: int, *, bounds: bool) -> int:
        """An accessor of `count` elements that are zero but at some; sparse where that is smaller.

        The morph targets that move nothing share one accessor.
        """
        extent = rows.extent if bounds else None
        if not len(rows.vertices):
            # one shared accessor of zeros per vertex count; a sparse one stores one, since not every loader takes none
            key = (count, extent is not None, rows.values.dtype.char)
            if key not in self._zeros:
                zeros = np.zeros((count if self._dense else 1, *rows.values.shape[1:]), dtype=rows.values.dtype)
                self._zeros[key] = (
                    self._add_dense(zeros, "vertex", rows.normalized, extent)
                    if self._dense
                    else self._add_sparse(np.zeros(1, np.uint8), zeros, count, rows.normalized, extent)
                )
            return self._zeros[key]
        indices = rows.vertices.astype(np.min_scalar_type(int(rows.vertices[-1])))
        if not self._dense and indices.nbytes + rows.values.nbytes < count * _padded_row(rows.values):
            return self._add_sparse(indices, rows.values, count, rows.normalized, extent)
        dense = np.zeros((count, *rows.values.shape[1:]), dtype=rows.values.dtype)
        dense[rows.vertices] = rows.values
        return self._add_dense(dense, "vertex", rows.normalized, extent)

    def add_bytes(self, data: bytes) -> int:
        """A buffer view of its own for bytes without an accessor; its index."""
        return self._append(_Key("bytes", 0, str(len(self._views))), data)[0]

    def finish(self) -> tuple[list[Json], list[Chunk]]:
        """The bufferViews, and the bytes of buffer 0 in pieces."""
        views: list[Json] = []
        chunks: list[Chunk] = []
        offset = 0
        for key, view in self._views.items():
            entry: Json = {"buffer": 0, "byteOffset": offset, "byteLength": view.size}
            if key.use in _TARGET:
                entry["target"] = _TARGET[key.use]
            if key.stride:
                entry["byteStride"] = key.stride
            views.append(entry)
            chunks += view.chunks
            offset += view.size
        return views, chunks

    def _add_dense(self, array: Array, use: Use, normalized: bool, extent: Extent | None) -> int:
        accessor = self._accessor(array, len(array), normalized, extent)
        stride = _padded_row(array) if use == "vertex" else 0
        label = str(len(self.accessors)) if self._apart and use == "index" else ""
        size = array.dtype.itemsize * math.prod(array.shape[1:])
        rows = array
        if stride > size:
            rows = np.zeros((len(array), stride), dtype=np.uint8)
            rows[:, :size] = _little(array).reshape(len(array), -1).view(np.uint8)
        accessor["bufferView"], offset = self._append(_Key(use, stride, label), _bytes(rows))
        if offset:
            accessor["byteOffset"] = offset
        return self._push(accessor)

    def _add_sparse(self, indices: Array, values: Array, count: int, normalized: bool, extent: Extent | None) -> int:
        accessor = self._accessor(values, count, normalized, extent)
        where: Json = {"componentType": _COMPONENT[indices.dtype.char]}
        where["bufferView"], where["byteOffset"] = self._append(_SPARSE, _bytes(indices))
        what: Json = {}
        what["bufferView"], what["byteOffset"] = self._append(_SPARSE, _bytes(values))
        accessor["sparse"] = {"count": len(indices), "indices": where, "values": what}
        self.sparse_count += 1
        return self._push(accessor)

    def _accessor(self, array: Array, count: int, normalized: bool, extent: Extent | None) -> Json:
        accessor: Json = {
            "componentType": _COMPONENT[array.dtype.char],
            "count": count,
            "type": _TYPE[array.shape[1:]],
        }
        if normalized:
            accessor["normalized"] = True
        if extent is not None:
            accessor |= {"min": extent.low, "max": extent.high}
        return accessor

    def _append(self, key: _Key, data: Chunk) -> tuple[int, int]:
        view = self._views.setdefault(key, _View(len(self._views)))
        return view.number, view.append(data)

    def _push(self, accessor: Json) -> int:
        self.accessors.append(accessor)
        return len(self.accessors) - 1


def require_finite(array: Array) -> None:
    """:raises ExportError: infinity, which is what float32 makes of numbers beyond its range"""
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise ExportError("glTF buffer", "numbers beyond float32 in metres, expected smaller ones")


def _padded_row(array: Array) -> int:
    """Bytes of one element, rounded up to the alignment that vertex attributes need."""
    size = array.dtype.itemsize * math.prod(array.shape[1:])
    return size + -size % _ALIGNMENT


def _bytes(array: Array) -> Chunk:
    """A view of an array's bytes; a copy where their order has to change."""
    return _little(array).data.cast("B") if array.size else b""


def _little(array: Array) -> Array:
    if array.shape[1:] == (4, 4):
        array = array.transpose(0, 2, 1)
    if sys.byteorder == "big":
        array = array.astype(array.dtype.newbyteorder("<"))
    return np.ascontiguousarray(array)
