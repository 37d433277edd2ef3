"""How vertex attributes are stored: as float32, or quantised to 8 and 16 bit integers (KHR_mesh_quantization)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray
from facepipe_gltf.influences import float_weights, integer_weights

_SHORT = 32767
_BYTE = 127
_USHORT = 65535


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
        """(n, k) skin weights."""
        return Encoded(integer_weights(weights), True) if self.quantize else Encoded(float_weights(weights), False)


def decode(encoded: Encoded) -> FloatArray:
    """What a reader gets."""
    if not encoded.normalized:
        return encoded.array.astype(np.float64)
    return np.maximum(encoded.array.astype(np.float64) / np.iinfo(encoded.array.dtype).max, -1.0)


def _signed(values: FloatArray, steps: int) -> Encoded:
    kind = np.int16 if steps == _SHORT else np.int8
    return Encoded(np.clip(np.rint(np.asarray(values, np.float64) * steps), -steps, steps).astype(kind), True)
