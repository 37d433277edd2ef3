"""Animation samplers, and when they are sampled so that straight lines between the samples mean what the keys mean.

USD interpolates linearly: a STEP channel gets a second key just before each next one, a CUBICSPLINE channel as many as
bring the lines near the curve.

Source: glTF 2.0 section 3.11 and appendix C (animation sampler interpolation modes).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.rig.animation import ON_FRAME, TICK, between, whole_frames
from facepipe.rig.trs import slerp
from facepipe_gltf.read import accessors
from facepipe_gltf.read.document import Document
from facepipe_gltf.read.values import Value

_RATES = (24.0, 25.0, 30.0, 50.0, 60.0, 120.0)  # frames per second that files are made at
_TOLERANCE = {"translation": 5e-5, "rotation": 5e-4, "scale": 5e-4, "weights": 5e-4}  # of curves: metres, radians, 1
_UNITS = {"translation": (1e3, " mm"), "rotation": (1.0, " rad"), "scale": (1.0, ""), "weights": (1.0, "")}
_NONE = 1e-6  # an error below this is that of float32
_MOST = 64  # lines that stand for the curve between two keys
_WITHIN = 4  # points of a line where its distance from the curve is measured
_AT_ONCE = 1 << 20  # numbers


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
    mode = value.get_or("interpolation", "LINEAR").text()
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
    # a cubic key is three rows: in-tangent, value, out-tangent
    triples = read.reshape(len(times), 3, width)
    return Sampler(value, mode, times, triples[:, 1], (triples[:, 0], triples[:, 2]))


def sample(sampler: Sampler, times: FloatArray, rotation: bool = False) -> FloatArray:
    """(t, width) values at `times` (t,), held before the first key and after the last; rotations get unit length."""
    left, right, share = between(sampler.times, times)
    span, share = sampler.times[right] - sampler.times[left], share[:, None]
    a, b = sampler.keys[left], sampler.keys[right]
    if sampler.mode == "STEP" or len(sampler.times) == 1:
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


@dataclass(frozen=True)
class Channel:
    """The track of one property of a node."""

    node: int
    path: str  # translation, rotation, scale, weights
    sampler: Sampler

    def at(self, times: FloatArray) -> FloatArray:
        """(t, width) values at `times` (t,)."""
        return sample(self.sampler, times, self.path == "rotation")


def sample_times(channels: Sequence[Channel], fps: float | None) -> FloatArray:
    """(t,) seconds to sample all `channels` at: their keys and times added between them, or whole frames of `fps`."""
    if fps is not None:
        first = min(channel.sampler.times[0] for channel in channels)
        last = max(channel.sampler.times[-1] for channel in channels)
        return whole_frames(first, last, fps)
    times_of_all = [channel.sampler.times for channel in channels]
    times_of_all += [_holds(channel.sampler) for channel in channels if channel.sampler.mode == "STEP"]
    times_of_all += [_bends(channel) for channel in channels if channel.sampler.mode == "CUBICSPLINE"]
    times = np.concatenate(times_of_all)
    return times[np.unique(times.astype(np.float32), return_index=True)[1]]  # the first of those alike: a key


def frame_rate(times: FloatArray) -> float:
    """The lowest of `_RATES` whose frames all `times` fall on; that of film where there is none."""
    return next((rate for rate in _RATES if _frames_off(times, rate).max(initial=0.0) < ON_FRAME), _RATES[0])


def on_frames(times: FloatArray, rate: float) -> FloatArray:
    """`times`, rounded to whole frames where float32 makes no difference; unchanged where two would become one."""
    found = np.where(_frames_off(times, rate) < ON_FRAME, np.rint(times * rate) / rate, times)
    return found if (np.diff(found) > 0).all() else times


def lines_error(channels: Sequence[Channel], times: FloatArray) -> str:
    """Largest distances of the lines between samples at `times` from the channels, as text."""
    largest: dict[str, float] = {}
    for channel in channels:
        off = float(_deviation(channel, times[:-1], times[1:], 1).max(initial=0.0))
        largest[channel.path] = max(largest.get(channel.path, 0.0), off)
    shown = [(path, *_UNITS[path]) for path in _UNITS if largest.get(path, 0.0) > _NONE]
    return ", ".join(f"{path} {largest[path] * factor:.2g}{unit}" for path, factor, unit in shown) or "nothing"


def _frames_off(times: FloatArray, rate: float) -> FloatArray:
    return np.asarray(np.abs(times * rate - np.rint(times * rate)))


def _holds(sampler: Sampler) -> FloatArray:
    """Times just before each key whose value differs from the one before."""
    changes = (np.diff(sampler.keys, axis=0) != 0).any(axis=1)
    span = np.diff(sampler.times)
    return np.asarray((sampler.times[1:] - np.minimum(TICK, span / 2))[changes])


def _bends(channel: Channel) -> FloatArray:
    """Times between keys that make lines of each curve, more where it bends more."""
    start, end = channel.sampler.times[:-1], channel.sampler.times[1:]
    added: list[FloatArray] = [np.zeros(0)]
    lines = 1
    while len(start) and lines < _MOST:
        bent = _deviation(channel, start, end, lines) > _TOLERANCE[channel.path]
        start, end, lines = start[bent], end[bent], 2 * lines
        added.append((start[:, None] + (end - start)[:, None] * (np.arange(1, lines) / lines)).ravel())
    return np.concatenate(added)


def _deviation(channel: Channel, start: FloatArray, end: FloatArray, lines: int) -> FloatArray:
    """(k,) largest distance of a channel from `lines` straight lines between each `start` and `end` (k,)."""
    points = lines * _WITHIN
    step = max(1, _AT_ONCE // ((points + 1) * channel.sampler.keys.shape[1]))
    distances: list[FloatArray] = [np.zeros(0)]
    for first in range(0, len(start), step):
        begin, span = start[first : first + step, None], (end - start)[first : first + step, None]
        times = begin + span * (np.arange(points + 1) / points)
        values = channel.at(times.ravel()).reshape(*times.shape, -1)
        distances.append(_from_lines(values, channel.path == "rotation"))
    return np.concatenate(distances)


def _from_lines(values: FloatArray, rotation: bool) -> FloatArray:
    """(k,) largest distance of (k, lines * _WITHIN + 1, width) values from the lines through every `_WITHIN`th."""
    ends = values[:, ::_WITHIN]
    a, b = ends[:, :-1, None], ends[:, 1:, None]
    if rotation:
        b = np.where((a * b).sum(axis=-1, keepdims=True) < 0.0, -b, b)
    share = (np.arange(_WITHIN) / _WITHIN)[:, None]
    line = a + share * (b - a)
    curve = values[:, :-1].reshape(line.shape)
    if not rotation:
        return np.asarray(np.abs(curve - line).max(axis=(1, 2, 3)))
    line = line / np.maximum(np.linalg.norm(line, axis=-1, keepdims=True), 1e-9)
    chord = np.minimum(np.linalg.norm(curve - line, axis=-1), np.linalg.norm(curve + line, axis=-1))
    return np.asarray(4.0 * np.arcsin(np.minimum(chord / 2.0, 1.0)).max(axis=(1, 2)))
