"""How vertex attributes are stored: few influences, float32 or 8 and 16 bit integers (KHR_mesh_quantization)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import ExportError
from facepipe.parts import Skin

MESHOPT = "EXT_meshopt_compression"
DRACO = "KHR_draco_mesh_compression"
_EVERY = slice(None)
_ROUNDING = 2e-7  # that a sum of float32 weights may be off
LOST = 1e-6  # weight that counts as left out
_SHORT = 32767
_BYTE = 127
_USHORT = 65535


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


def merge(skin: Skin, points: IntArray | slice = _EVERY) -> tuple[IntArray, FloatArray]:
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
