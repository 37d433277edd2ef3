"""What sliders do, as ramps: each rises from 0 to 1 between two values of its slider and is constant beyond.

A straight entry is one ramp over the slider's range, a curve one for each of its pieces. So clamping to the range comes
of itself, and no large numbers cancel out, however steep a curve is.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import ExportError
from facepipe.onnx_graph import Nodes
from facepipe.parts import Curve, Slider
from facepipe.rig import CHANNELS, Rig, rest_coefficients
from facepipe.rig.sliders import channel_entries, response, shape_entries

_BUSY = (0.05, 0.2, 0.5, 1.0)  # shares of the sliders that are off their defaults


class Ramps(NamedTuple):
    """``base + ramps @ gains``: bone coefficients and shape weights of the sliders."""

    sliders: IntArray  # (k,) the slider of each ramp
    starts: FloatArray  # (k,) slider value where it leaves 0
    ends: FloatArray  # (k,) slider value where it reaches 1
    base: FloatArray  # (9 j,) bone coefficients with all ramps at 0
    gains: FloatArray  # (k, 9 j)
    shape_base: FloatArray  # (shapes,)
    shape_gains: FloatArray  # (k, shapes)


def ramps_of(rig: Rig, sliders: Sequence[Slider], whole: Collection[str] = ()) -> Ramps:
    """The ramps of sliders on a rig, which `facepipe.rig.slide` takes.

    :param whole: sliders that have a ramp over their range in any case, unless that is a single value
    :raises ExportError: an empty range, an unknown shape, or sliders that move nothing
    """
    joint_columns = 9 * len(rig.joints)
    base = np.append(rest_coefficients(len(rig.joints)).ravel(), np.zeros(len(rig.shapes)))
    rows: dict[tuple[int, float, float], FloatArray] = {}
    for number, slider in enumerate(sliders):
        if slider.minimum > slider.maximum:
            raise ExportError(
                f"{rig.name} -> slider {slider.name}", f"range {slider.minimum:g} to {slider.maximum:g} is empty"
            )
        if slider.name in whole and slider.minimum < slider.maximum:
            rows[number, slider.minimum, slider.maximum] = np.zeros(len(base))
        for column, gain, curve in _entries(rig, slider):
            values = _values(slider, curve)
            amounts = [gain * response(curve, value, slider.default) for value in values]
            # curve(x) = its first value + sum of rises * clip((x - start) / (end - start), 0, 1)
            base[column] += amounts[0]
            for piece, (low, high) in zip(itertools.pairwise(values), itertools.pairwise(amounts), strict=True):
                if high != low:
                    rows.setdefault((number, *piece), np.zeros(len(base)))[column] += high - low
    if not rows:
        raise ExportError(rig.name, "no slider that moves a joint or a shape, expected some")
    keys = sorted(rows)
    gains = np.array([rows[key] for key in keys])
    numbers, starts, ends = (np.array(column) for column in zip(*keys, strict=True))
    return Ramps(
        sliders=numbers,
        starts=starts,
        ends=ends,
        base=base[:joint_columns],
        gains=gains[:, :joint_columns],
        shape_base=base[joint_columns:],
        shape_gains=gains[:, joint_columns:],
    )


def _entries(rig: Rig, slider: Slider) -> Iterator[tuple[int, float, Curve | None]]:
    """Column, gain and curve of everything that a slider adds to."""
    for (joint, channel, gain), curve in channel_entries(slider):
        yield 9 * rig.joints.index(joint) + CHANNELS.index(channel), gain, curve
    for (shape, gain), curve in shape_entries(slider):
        if shape not in rig.shapes:
            raise ExportError(f"{rig.name} -> slider {slider.name}", f"no shape '{shape}'")
        yield 9 * len(rig.joints) + rig.shapes.index(shape), gain, curve


def _values(slider: Slider, curve: Curve | None) -> list[float]:
    """Slider values between which an entry is straight, from minimum to maximum."""
    inner = {value for value, _ in curve or () if slider.minimum < value < slider.maximum}
    return sorted({slider.minimum, slider.maximum, *inner})


def ramp_nodes(nodes: Nodes, ramps: Ramps, sliders: int) -> str:
    """[batch, k] values 0..1 of the ramps, from the input ``sliders``."""
    values = "sliders"
    if not np.array_equal(ramps.sliders, np.arange(sliders)):
        values = nodes.gather(values, 1, ramps.sliders)
    past = nodes.add("Sub", values, nodes.constant("ramp_starts", ramps.starts[None]))
    risen = nodes.add("Mul", past, nodes.constant("ramp_slopes", 1 / (ramps.ends - ramps.starts)[None]))
    bounds = [nodes.constant(name, np.array(value)) for name, value in (("zero", 0.0), ("full", 1.0))]
    return nodes.add("Clip", risen, *bounds)


def slider_samples(sliders: Sequence[Slider], count: int, seed: int) -> FloatArray:
    """(count, sliders) values: the defaults, then random ones of few sliders and of many."""
    random = np.random.default_rng(seed)
    low, high, rest = (
        np.array([getattr(slider, key) for slider in sliders]) for key in ("minimum", "maximum", "default")
    )
    values = low + random.random((count, len(sliders))) * (high - low)
    moved = random.random(values.shape) < random.choice(_BUSY, size=(count, 1))
    moved[0] = False
    return np.where(moved, values, rest)


def ramp_samples(ramps: Ramps, values: FloatArray) -> FloatArray:
    """(count, k) values 0..1 of the ramps under (count, sliders) values."""
    return np.asarray(((values[:, ramps.sliders] - ramps.starts) / (ramps.ends - ramps.starts)).clip(0.0, 1.0))
