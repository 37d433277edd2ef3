"""When animations are sampled, so that straight lines between the samples mean what the keys mean.

USD interpolates linearly: a STEP channel gets a second key just before each next one, a CUBICSPLINE channel as many as
bring the lines near the curve.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.rig.animation import ON_FRAME, TICK, whole_frames
from facepipe_gltf.read.samplers import Sampler, sample

RATES = (24.0, 25.0, 30.0, 50.0, 60.0, 120.0)  # frames per second that files are made at
_TOLERANCE = {"translation": 5e-5, "rotation": 5e-4, "scale": 5e-4, "weights": 5e-4}  # of curves: metres, radians, 1
_UNITS = {"translation": (1e3, " mm"), "rotation": (1.0, " rad"), "scale": (1.0, ""), "weights": (1.0, "")}
_NONE = 1e-6  # an error below this is that of float32
_MOST = 64  # lines that stand for the curve between two keys
_WITHIN = 4  # points of a line where its distance from the curve is measured
_AT_ONCE = 1 << 20  # numbers


@dataclass(frozen=True)
class Channel:
    """What moves one property of a node."""

    node: int
    path: str  # translation, rotation, scale, weights
    sampler: Sampler

    def at(self, times: FloatArray) -> FloatArray:
        """(t, width) values at `times` (t,)."""
        return sample(self.sampler, times, self.path == "rotation")


def sample_times(channels: Sequence[Channel], fps: float | None) -> FloatArray:
    """(t,) seconds to sample all `channels` at: their keys and what stands between them, or whole frames of `fps`."""
    if fps is not None:
        first = min(channel.sampler.times[0] for channel in channels)
        last = max(channel.sampler.times[-1] for channel in channels)
        return whole_frames(first, last, fps)
    found = [channel.sampler.times for channel in channels]
    found += [_holds(channel.sampler) for channel in channels if channel.sampler.mode == "STEP"]
    found += [_bends(channel) for channel in channels if channel.sampler.mode == "CUBICSPLINE"]
    times = np.concatenate(found)
    return times[np.unique(times.astype(np.float32), return_index=True)[1]]  # the first of those alike: a key


def frame_rate(times: FloatArray) -> float:
    """The lowest of `RATES` whose frames all `times` fall on; that of film where there is none."""
    return next((rate for rate in RATES if _frames_off(times, rate).max(initial=0.0) < ON_FRAME), RATES[0])


def on_frames(times: FloatArray, rate: float) -> FloatArray:
    """`times`, those that are a whole frame in float32 exactly so; as they are where two would become one."""
    found = np.where(_frames_off(times, rate) < ON_FRAME, np.rint(times * rate) / rate, times)
    return found if (np.diff(found) > 0).all() else times


def lines_error(channels: Sequence[Channel], times: FloatArray) -> str:
    """How far lines between the samples at `times` are from the channels, at most, for people."""
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
    found: list[FloatArray] = [np.zeros(0)]
    lines = 1
    while len(start) and lines < _MOST:
        bent = _deviation(channel, start, end, lines) > _TOLERANCE[channel.path]
        start, end, lines = start[bent], end[bent], 2 * lines
        found.append((start[:, None] + (end - start)[:, None] * (np.arange(1, lines) / lines)).ravel())
    return np.concatenate(found)


def _deviation(channel: Channel, start: FloatArray, end: FloatArray, lines: int) -> FloatArray:
    """(k,) largest distance of a channel from `lines` straight lines between each `start` and `end` (k,)."""
    points = lines * _WITHIN
    step = max(1, _AT_ONCE // ((points + 1) * channel.sampler.keys.shape[1]))
    found: list[FloatArray] = [np.zeros(0)]
    for first in range(0, len(start), step):
        begin, span = start[first : first + step, None], (end - start)[first : first + step, None]
        times = begin + span * (np.arange(points + 1) / points)
        values = channel.at(times.ravel()).reshape(*times.shape, -1)
        found.append(_from_lines(values, channel.path == "rotation"))
    return np.concatenate(found)


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
