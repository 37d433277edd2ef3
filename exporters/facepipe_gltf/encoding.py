"""How vertex attributes are stored: as float32, or quantised to 8 and 16 bit integers (KHR_mesh_quantization)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from facepipe.parts import FloatArray
from facepipe_gltf.influences import float_weights, integer_weights

_SHORT = 32767
_BYTE = 127
_USHORT = 65535


class Encoded(NamedTuple):
    """An array as stored, and whether its integers stand for fractions of their range."""

    array: npt.NDArray[Any]
    normalized: bool


@dataclass(frozen=True)
class Grid:
    """A cube of 16 bit steps: ``point = center + half * (steps / 32767)``; offsets share `half`."""

    center: FloatArray  # (3,) metres
    half: float  # metres

    @property
    def matrix(self) -> FloatArray:
        """(4, 4) from stored to real positions."""
        matrix = np.diag([self.half, self.half, self.half, 1.0])
        matrix[:3, 3] = self.center
        return matrix


def grid_around(points: Sequence[FloatArray], offsets: Sequence[FloatArray]) -> Grid:
    """The smallest cube that holds all points (n, 3) and, around its centre, all offsets (k, 3)."""
    filled = [array for array in points if len(array)]
    if not filled:
        return Grid(np.zeros(3), 1.0)
    low = np.min([array.min(axis=0) for array in filled], axis=0)
    high = np.max([array.max(axis=0) for array in filled], axis=0)
    reach = max((float(np.abs(array).max()) for array in offsets if array.size), default=0.0)
    half = max(float((high - low).max()) / 2, reach)
    # float32 numbers, so that the file's own transform undoes exactly these steps
    return Grid(((low + high) / 2).astype(np.float32).astype(np.float64), float(np.float32((half or 1.0) * (1 + 1e-6))))


@dataclass(frozen=True)
class Encoding:
    """Stores attributes: quantised where there is a grid, float32 where not."""

    grid: Grid | None = None

    def positions(self, points: FloatArray) -> Encoded:
        """(n, 3) points in metres."""
        if self.grid is None:
            return Encoded(points.astype(np.float32), False)
        return _signed((points - self.grid.center) / self.grid.half, _SHORT)

    def offsets(self, offsets: FloatArray) -> Encoded:
        """(k, 3) morph offsets in metres."""
        if self.grid is None:
            return Encoded(offsets.astype(np.float32, copy=False), False)
        return _signed(offsets / self.grid.half, _SHORT)

    def directions(self, vectors: FloatArray) -> Encoded:
        """(n, 3 or 4) unit normals or tangents."""
        return Encoded(vectors.astype(np.float32), False) if self.grid is None else _signed(vectors, _BYTE)

    def uvs(self, uvs: FloatArray) -> Encoded:
        """(n, 2) texture coordinates; quantised where all lie in 0..1."""
        if self.grid is None or (uvs.size and (uvs.min() < 0 or uvs.max() > 1)):
            return Encoded(uvs.astype(np.float32), False)
        return Encoded(np.rint(uvs.astype(np.float64) * _USHORT).astype(np.uint16), True)

    def colors(self, colors: FloatArray) -> Encoded:
        """(n, 3) linear colours 0..1."""
        clipped = np.clip(colors, 0, 1)
        if self.grid is None:
            return Encoded(clipped.astype(np.float32), False)
        return Encoded(np.rint(np.asarray(clipped, np.float64) * _USHORT).astype(np.uint16), True)

    def weights(self, weights: FloatArray) -> Encoded:
        """(n, k) skin weights."""
        return Encoded(float_weights(weights), False) if self.grid is None else Encoded(integer_weights(weights), True)


def decode(encoded: Encoded) -> FloatArray:
    """What a reader gets."""
    if not encoded.normalized:
        return encoded.array.astype(np.float64)
    return np.maximum(encoded.array.astype(np.float64) / np.iinfo(encoded.array.dtype).max, -1.0)


def _signed(values: FloatArray, steps: int) -> Encoded:
    kind = np.int16 if steps == _SHORT else np.int8
    return Encoded(np.clip(np.rint(np.asarray(values, np.float64) * steps), -steps, steps).astype(kind), True)
