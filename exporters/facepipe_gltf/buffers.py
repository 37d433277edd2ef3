"""How arrays are stored in a glTF file: few influences, KHR_mesh_quantization, accessors and buffer views."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import ExportError
from facepipe.parts import Skin
from facepipe.records import Json

Array = npt.NDArray[Any]
Chunk = bytes | memoryview
Use = Literal["vertex", "index", "matrices", "keys"]

MESHOPT = "EXT_meshopt_compression"
DRACO = "KHR_draco_mesh_compression"
_ROUNDING = 2e-7  # that a sum of float32 weights may be off
LOST = 1e-6  # weight that counts as left out
_SHORT = 32767
_BYTE = 127
_USHORT = 65535
_COMPONENT = {"b": 5120, "B": 5121, "h": 5122, "H": 5123, "I": 5125, "L": 5125, "f": 5126}
_TYPE = {(): "SCALAR", (2,): "VEC2", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}
_TARGET = {"vertex": 34962, "index": 34963}
_ALIGNMENT = 4


class Influences(NamedTuple):
    """Joints (n, k) int64 and weights (n, k) of every point, largest first; unused ones are joint 0, weight 0."""

    joints: IntArray
    weights: FloatArray
    lost: FloatArray  # (n,) part of the weight that went with the influences left out

    @property
    def any_lost(self) -> bool:
        """Whether influences of some point were left out."""
        return bool((self.lost > LOST).any())


def limit(skin: Skin, most: int, where: str) -> Influences:
    """The `most` largest influences of every point, renormalised in float64.

    :raises ExportError: a negative weight, or a point without any
    """
    joints, weights = merge(skin)
    if weights.size and weights.min() < 0:
        point = int(np.argmin(weights.min(axis=1)))
        raise ExportError(where, f"point {point} has a negative skin weight, expected 0..1")
    total = weights.sum(axis=1)
    if len(total) and total.min() <= 1e-9:
        raise ExportError(where, f"point {int(np.argmin(total))} has no skin weight, expected weights that sum to 1")
    order = np.argsort(-weights, axis=1, kind="stable")[:, :most]
    joints = np.take_along_axis(joints, order, axis=1)
    weights = np.take_along_axis(weights, order, axis=1)
    kept = weights.sum(axis=1)
    lost = 1.0 - kept / total
    kept[np.abs(kept - 1.0) <= _ROUNDING] = 1.0  # normalised before: their bits stay
    return Influences(np.where(weights > 0, joints, 0), weights / kept[:, None], lost)


def merge(skin: Skin, points: IntArray | slice = slice(None)) -> tuple[IntArray, FloatArray]:
    """Joint indices and weights (n, k) of `points` with every joint once a point: repeated ones are summed."""
    joints = np.asarray(skin.joint_indices)[points].astype(np.int64)
    order = np.argsort(joints, axis=1, kind="stable")
    joints = np.take_along_axis(joints, order, axis=1)
    weights = np.take_along_axis(np.asarray(skin.joint_weights)[points].astype(np.float64), order, axis=1)
    for column in range(1, joints.shape[1]):
        repeated = joints[:, column] == joints[:, column - 1]
        weights[repeated, column] += weights[repeated, column - 1]
        weights[repeated, column - 1] = 0.0
    return joints, weights


class Encoded(NamedTuple):
    """An array as stored, and whether its integers stand for fractions of their range."""

    array: npt.NDArray[Any]
    normalized: bool


@dataclass(frozen=True)
class Encoding:
    """Stores attributes: as float32, or quantised so that no node and no inverse bind has to scale them back.

    Points therefore stay float32, and integer offsets are fractions of one metre.
    """

    quantize: bool = False

    def positions(self, points: FloatArray) -> Encoded:
        """(n, 3) points in metres."""
        return Encoded(points.astype(np.float32), False)

    def offsets(self, offsets: FloatArray) -> Encoded:
        """(k, 3) morph offsets in metres; quantised where all lie in -1..1."""
        if not self.quantize or (offsets.size and np.abs(offsets).max() > 1):
            return Encoded(offsets.astype(np.float32, copy=False), False)
        return _signed(offsets, _SHORT)

    def directions(self, vectors: FloatArray) -> Encoded:
        """(n, 3 or 4) unit normals or tangents."""
        return _signed(vectors, _BYTE) if self.quantize else Encoded(vectors.astype(np.float32), False)

    def uvs(self, uvs: FloatArray) -> Encoded:
        """(n, 2) texture coordinates; quantised where all lie in 0..1."""
        if not self.quantize or (uvs.size and (uvs.min() < 0 or uvs.max() > 1)):
            return Encoded(uvs.astype(np.float32), False)
        return Encoded(np.rint(uvs.astype(np.float64) * _USHORT).astype(np.uint16), True)

    def colors(self, colors: FloatArray) -> Encoded:
        """(n, 3) linear colours 0..1."""
        clipped = np.clip(colors, 0, 1)
        if not self.quantize:
            return Encoded(clipped.astype(np.float32), False)
        return Encoded(np.rint(np.asarray(clipped, np.float64) * _USHORT).astype(np.uint16), True)

    def weights(self, weights: FloatArray) -> Encoded:
        """(n, k) skin weights, largest first: it takes up the rounding of the others, so that the exact sum is 1."""
        if self.quantize:
            steps = np.rint(weights * _USHORT).astype(np.int64)
            steps[:, 0] += _USHORT - steps.sum(axis=1)
            return Encoded(steps.astype(np.uint16), True)
        rounded = weights.astype(np.float32)
        rounded[:, 0] = 1.0 - rounded[:, 1:].sum(axis=1, dtype=np.float64)
        return Encoded(rounded, False)


def decode(encoded: Encoded) -> FloatArray:
    """What a reader gets."""
    if not encoded.normalized:
        return encoded.array.astype(np.float64)
    return np.maximum(encoded.array.astype(np.float64) / np.iinfo(encoded.array.dtype).max, -1.0)


def _signed(values: FloatArray, steps: int) -> Encoded:
    kind = np.int16 if steps == _SHORT else np.int8
    return Encoded(np.clip(np.rint(np.asarray(values, np.float64) * steps), -steps, steps).astype(kind), True)


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
        """Add `data`, aligned: the number of its view, and its offset there."""
        view = self._views.setdefault(key, _View(len(self._views)))
        offset, padding = view.size, -len(data) % _ALIGNMENT
        view.chunks += [data, bytes(padding)] if padding else [data]
        view.size += len(data) + padding
        return view.number, offset

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
