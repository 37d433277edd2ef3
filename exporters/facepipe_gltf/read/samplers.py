"""Animation samplers: key times and values, and their values at other times.

Source: glTF 2.0 section 3.11 and appendix C (animation sampler interpolation modes).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.rig.trs import slerp
from facepipe_gltf.read import accessors
from facepipe_gltf.read.document import Document
from facepipe_gltf.read.values import Value


@dataclass(frozen=True)
class Sampler:
    """Keys of one channel."""

    value: Value
    mode: str  # STEP, LINEAR or CUBICSPLINE
    times: FloatArray  # (k,) seconds, ascending
    keys: FloatArray  # (k, width)
    tangents: tuple[FloatArray, FloatArray] | None  # (k, width) in and out, for CUBICSPLINE


def read_sampler(document: Document, value: Value, kind: str, width: int) -> Sampler:
    """The sampler at `value`, of `width` numbers a key, in accessors of type `kind` (SCALAR for morph weights).

    :raises InputError: times that don't ascend, or keys that don't fit them
    """
    interpolation = value.get("interpolation")
    mode = "LINEAR" if interpolation is None else interpolation.text()
    if mode not in ("STEP", "LINEAR", "CUBICSPLINE"):
        raise value.error(f"interpolation {ascii(mode)[:40]}, expected STEP, LINEAR or CUBICSPLINE")
    times = accessors.floats(document, value.require("input"), "SCALAR")[:, 0].astype(np.float64)
    if np.any(np.diff(times) <= 0.0):
        raise value.require("input").error("key times that don't ascend")
    output = value.require("output")
    read = accessors.floats(document, output, kind).astype(np.float64)
    cubic = mode == "CUBICSPLINE"
    expected = len(times) * width * (3 if cubic else 1)
    if read.size != expected:
        raise output.error(f"{read.size} numbers for {len(times)} keys, expected {expected}")
    if not cubic:
        return Sampler(value, mode, times, read.reshape(len(times), width), None)
    triples = read.reshape(len(times), 3, width)
    return Sampler(value, mode, times, triples[:, 1], (triples[:, 0], triples[:, 2]))


def sample(sampler: Sampler, times: FloatArray, rotation: bool = False) -> FloatArray:
    """(t, width) values at `times` (t,), held before the first key and after the last; rotations get unit length."""
    last = len(sampler.times) - 1
    left = np.clip(np.searchsorted(sampler.times, times, side="right") - 1, 0, last)
    right = np.minimum(left + 1, last)
    span = sampler.times[right] - sampler.times[left]
    share = np.clip((times - sampler.times[left]) / np.where(span > 0.0, span, 1.0), 0.0, 1.0)[:, None]
    a, b = sampler.keys[left], sampler.keys[right]
    if sampler.mode == "STEP" or last == 0:
        values = a
    elif sampler.tangents is not None:
        arrive, leave = sampler.tangents
        values = _hermite(a, span[:, None] * leave[left], b, span[:, None] * arrive[right], share)
    elif rotation:
        values = slerp(_unit(sampler, a), _unit(sampler, b), share)
    else:
        values = np.where(share == 0.0, a, a + share * (b - a))
    return _unit(sampler, values) if rotation else values


def _hermite(a: FloatArray, out: FloatArray, b: FloatArray, into: FloatArray, s: FloatArray) -> FloatArray:
    s2, s3 = s * s, s * s * s
    return np.asarray((2 * s3 - 3 * s2 + 1) * a + (s3 - 2 * s2 + s) * out + (3 * s2 - 2 * s3) * b + (s3 - s2) * into)


def _unit(sampler: Sampler, quaternions: FloatArray) -> FloatArray:
    length = np.linalg.norm(quaternions, axis=1, keepdims=True)
    if length.min() < 1e-6:
        raise sampler.value.require("output").error("a rotation of length 0, expected unit quaternions")
    return np.asarray(quaternions / length)
