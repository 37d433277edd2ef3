"""Sliders, and learned networks of several, which add to bone coefficients and shape weights."""

from __future__ import annotations

import itertools
from bisect import bisect_right
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from operator import itemgetter

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray
from facepipe.core.errors import InputError
from facepipe.core.names import unknown
from facepipe.parts import Curve, Slider, SliderNetwork
from facepipe.rig.bone_coefficients import CHANNELS, rest_coefficients

_NO_EFFECT = 0.01  # of an effect: less is rounding


def _silu(values: FloatArray) -> FloatArray:
    from scipy.special import expit  # a tenth of a second, which few faces need

    return np.asarray(values * expit(values))


ACTIVATIONS: Mapping[str, Callable[[FloatArray], FloatArray]] = {
    "tanh": np.tanh,
    "relu": lambda values: np.maximum(values, 0.0),
    "silu": _silu,
}


def network_outputs(network: SliderNetwork, values: FloatArray) -> FloatArray:
    """(..., outputs) of (..., inputs) clamped slider values: those of the channels, then those of the shapes."""
    layer: FloatArray = np.asarray(values, dtype=np.float64)
    for number, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        if number:
            layer = ACTIVATIONS[network.activation](layer)
        layer = layer @ np.asarray(weight, dtype=np.float64).T + bias
    return layer


def check_network(network: SliderNetwork, sliders: Collection[str], joints: Sequence[str]) -> None:
    """:raises InputError: a damaged network, or one of a slider, joint or channel that is not there"""
    fault = network_fault(network)
    if fault:
        raise InputError("slider network", fault)
    for name in network.sliders:
        if name not in sliders:
            raise InputError("slider network", f"no slider '{name}'")
    for joint, channel in network.channels:
        if joint not in joints or channel not in CHANNELS:
            raise InputError("slider network", f"no joint '{joint}' with a channel '{channel}'")


def network_fault(network: SliderNetwork) -> str | None:
    """The fault of a network by itself, with the expected value; None where it is sound."""
    if network.activation not in ACTIVATIONS:
        return f"activation '{network.activation}', expected one of {', '.join(ACTIVATIONS)}"
    for what, names in (("slider", network.sliders), ("channel", network.channels), ("shape", network.shapes)):
        if len(set(names)) != len(names):
            return f"a {what} twice, expected each once"
    if not network.weights or len(network.weights) != len(network.biases):
        counts = f"{len(network.weights)} weights and {len(network.biases)} biases"
        return f"{counts}, expected one or more layers of both"
    sizes = [len(network.sliders), *(bias.size for bias in network.biases)]
    for number, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        expected = (sizes[number + 1], sizes[number])
        if bias.ndim != 1 or weight.shape != expected:
            return f"layer {number}: weight {weight.shape} and bias {bias.shape}, expected a weight {expected}"
        if not (np.isfinite(weight).all() and np.isfinite(bias).all()):
            return f"layer {number}: NaN or infinity, expected finite numbers"
    outputs = len(network.channels) + len(network.shapes)
    if sizes[-1] != outputs or not outputs or not network.sliders:
        return f"{sizes[0]} sliders and {sizes[-1]} outputs for {outputs} channels and shapes, expected as many, some"
    return None


def shape_changes(network: SliderNetwork, sliders: Sequence[Slider]) -> dict[str, dict[str, float]]:
    """The most that each shape's weight changes as one slider alone goes to its ends, for every slider it takes.

    The others are at their defaults, at their least and at their largest values meanwhile: what two sliders do together
    counts for both. Sliders that the first layer weighs with 0 do nothing.
    """
    by_name = {slider.name: slider for slider in sliders}
    ranges = np.array(
        [[by_name[name].default, by_name[name].minimum, by_name[name].maximum] for name in network.sliders]
    )
    changes = {}
    for number, name in enumerate(network.sliders):
        values = np.repeat(ranges.T[:, None], 3, axis=1)  # by what the others and this one are at
        values[:, :, number] = ranges[number]
        weights = network_outputs(network, values)[..., len(network.channels) :]
        if network.weights[0][:, number].any():
            changes[name] = dict(zip(network.shapes, np.ptp(weights, axis=1).max(axis=0).tolist(), strict=True))
    return changes


def kept_outputs(
    network: SliderNetwork, joint: Callable[[str], bool], shape: Callable[[str], bool]
) -> SliderNetwork | None:
    """A network with only the channels and shapes whose names pass; None where none is left."""
    passes = [joint(name) for name, _ in network.channels], [shape(name) for name in network.shapes]
    rows = np.flatnonzero(np.concatenate([*map(np.asarray, passes), []]).astype(bool))
    if not len(rows):
        return None
    return replace(
        network,
        channels=tuple(itertools.compress(network.channels, passes[0])),
        shapes=tuple(itertools.compress(network.shapes, passes[1])),
        weights=(*network.weights[:-1], network.weights[-1][rows]),
        biases=(*network.biases[:-1], network.biases[-1][rows]),
    )


def slide(
    sliders: Sequence[Slider],
    joints: Sequence[str],
    values: Mapping[str, float] | None = None,
    network: SliderNetwork | None = None,
) -> tuple[FloatArray, dict[str, float]]:
    """Bone coefficients (j, 9) and shape weights that slider values stand for.

    Each slider adds ``gain * (value - default)`` to its channels and shapes, or ``gain * curve(value)`` to those with a
    curve; values are clamped to the slider's range. Sliders that are not in `values` keep their authored value. The
    `network` of the face adds what it makes of the clamped values. The sum is clamped to nothing.

    :raises InputError: a value for no slider, a value that is not finite, a slider of an unknown joint or channel, a
        damaged curve or network, or one of sliders, joints or channels that are not there
    """
    coefficients = rest_coefficients(len(joints))
    weights: dict[str, float] = {}
    joint_index = {joint: i for i, joint in enumerate(joints)}
    settings = dict(values or {})
    clamped: dict[str, float] = {}
    for slider in sliders:
        fault = curves_fault(slider)
        if fault:
            raise InputError(f"slider {slider.name}", fault)
        # clamped before anything reads it: outside its range a network was never trained
        value = clamped[slider.name] = _clamped(slider, settings.pop(slider.name, slider.setting))
        for (joint, channel, gain), curve in channel_entries(slider):
            if joint not in joint_index or channel not in CHANNELS:
                raise InputError(f"slider {slider.name}", f"no joint '{joint}' with a channel '{channel}'")
            amount = response(curve, value, slider.default)
            coefficients[joint_index[joint], CHANNELS.index(channel)] += gain * amount
        for (shape, gain), curve in shape_entries(slider):
            weights[shape] = weights.get(shape, 0.0) + gain * response(curve, value, slider.default)
    if settings:
        raise InputError("sliders", unknown(next(iter(settings)), [*clamped], "slider"))
    if network is not None:
        check_network(network, clamped, joints)
        amounts = network_outputs(network, np.array([clamped[name] for name in network.sliders]))
        for (joint, channel), amount in zip(network.channels, amounts, strict=False):
            coefficients[joint_index[joint], CHANNELS.index(channel)] += amount
        for shape, amount in zip(network.shapes, amounts[len(network.channels) :], strict=True):
            weights[shape] = weights.get(shape, 0.0) + float(amount)
    return coefficients, weights


def mode_weights(sliders: Sequence[Slider], values: Mapping[str, float] | None = None) -> dict[int, float]:
    """What sliders add to modes of the face's basis, in standard deviations; those that get nothing are left out.

    :param values: in place of the authored ones
    :raises InputError: a value that is not finite
    """
    weights: dict[int, float] = {}
    for slider in sliders:
        if slider.modes:
            amount = _clamped(slider, (values or {}).get(slider.name, slider.setting)) - slider.default
            for mode, gain in slider.modes if amount else ():
                weights[mode] = weights.get(mode, 0.0) + gain * amount
    return {mode: weight for mode, weight in weights.items() if weight}


def modes_line(sliders: Sequence[Slider]) -> tuple[str, ...]:
    """What a report of a file says whose readers have no basis of people: a line for sliders over its modes."""
    names = [slider.name for slider in sliders if slider.modes]
    return (f"{len(names)} sliders over modes of people ({names[0]} ... {names[-1]}), set or not",) if names else ()


def response(curve: Curve | None, value: float, default: float) -> float:
    """The factor of an entry's gain at a slider value that is in range."""
    if curve is None:
        return value - default
    after = bisect_right(curve, value, key=itemgetter(0))
    if after in (0, len(curve)):
        return float(curve[max(after - 1, 0)][1])
    (low, first), (high, last) = curve[after - 1 : after + 1]
    return float(first + (last - first) * ((value - low) / (high - low)))


def channel_entries(slider: Slider) -> Iterator[tuple[tuple[str, str, float], Curve | None]]:
    """The channels of a slider with their curves."""
    return zip(slider.channels, slider.channel_curves or (None,) * len(slider.channels), strict=True)


def shape_entries(slider: Slider) -> Iterator[tuple[tuple[str, float], Curve | None]]:
    """The shapes of a slider with their curves."""
    return zip(slider.shapes, slider.shape_curves or (None,) * len(slider.shapes), strict=True)


def with_entries(
    slider: Slider,
    channels: Sequence[tuple[tuple[str, str, float], Curve | None]],
    shapes: Sequence[tuple[tuple[str, float], Curve | None]],
) -> Slider:
    """A slider with other entries, each with its curve; no lists of curves where there are none."""
    channel_curves, shape_curves = (tuple(curve for _, curve in entries) for entries in (channels, shapes))
    return replace(
        slider,
        channels=tuple(entry for entry, _ in channels),
        shapes=tuple(entry for entry, _ in shapes),
        channel_curves=channel_curves if any(channel_curves) else (),
        shape_curves=shape_curves if any(shape_curves) else (),
    )


def kept(slider: Slider, joint: Callable[[str], bool], shape: Callable[[str], bool]) -> Slider:
    """A slider with only the channels and shapes whose names pass."""
    return with_entries(
        slider,
        [entry for entry in channel_entries(slider) if joint(entry[0][0])],
        [entry for entry in shape_entries(slider) if shape(entry[0][0])],
    )


def resting_at(slider: Slider, value: float) -> Slider:
    """The slider with `value` as its default, at which it then adds nothing."""

    def shifted(curve: Curve | None) -> Curve | None:
        if curve is None:
            return None
        start = response(curve, value, slider.default)
        return tuple((at, amount - start) for at, amount in curve)

    channels = [(entry, shifted(curve)) for entry, curve in channel_entries(slider)]
    shapes = [(entry, shifted(curve)) for entry, curve in shape_entries(slider)]
    return replace(with_entries(slider, channels, shapes), default=value, value=None)


def network_resting_at(network: SliderNetwork, values: Mapping[str, float]) -> SliderNetwork:
    """The network less what it adds at the values of its sliders."""
    start = network_outputs(network, np.array([values[name] for name in network.sliders]))
    return replace(network, biases=(*network.biases[:-1], network.biases[-1] - start))


def with_mutual_mirrors(sliders: Sequence[Slider]) -> tuple[Slider, ...]:
    """The sliders without the mirrors that are not there or that name another."""
    return tuple(
        slider if mirror_fault(slider, sliders) is None else replace(slider, mirror=None) for slider in sliders
    )


@lru_cache(maxsize=1 << 14)
def curve_fault(curve: Curve) -> str | None:
    """The fault of a curve in float32, which files hold, with the expected value; None where it is sound."""
    if len(curve) < 2 or any(len(knot) != 2 for knot in curve):
        return f"a curve of {len(curve)} knots, expected 2 or more of a value and an amount each"
    with np.errstate(over="ignore"):  # beyond float32 is infinity
        values, amounts = np.array(curve, dtype=np.float32).T
    if not (np.isfinite(values).all() and np.isfinite(amounts).all()):
        return "a curve with NaN or infinity, expected finite knots"
    if (values[1:] <= values[:-1]).any():
        late = int(np.argmax(values[1:] <= values[:-1]))
        return f"knot values {values[late]:g}, {values[late + 1]:g} of a curve, expected them strictly ascending"
    if (amounts[1:] > amounts[:-1]).any() and (amounts[1:] < amounts[:-1]).any():
        return "a curve that rises and falls, expected a monotone one"
    return None


def curves_fault(slider: Slider) -> str | None:
    """The fault of a slider's curves; None where they are sound."""
    for kind, entries, curves in (
        ("channels", slider.channels, slider.channel_curves),
        ("shapes", slider.shapes, slider.shape_curves),
    ):
        if curves and len(curves) != len(entries):
            return f"{len(curves)} curves of {kind}, expected none or {len(entries)}"
        for curve in curves:
            fault = None if curve is None else curve_fault(curve)
            if fault:
                return fault
    return None


def mirror_fault(slider: Slider, sliders: Sequence[Slider]) -> str | None:
    """The fault of a slider's mirror among those of its face; None where it has none, or a mutual one."""
    if slider.mirror is None:
        return None
    other = next((candidate for candidate in sliders if candidate.name == slider.mirror), None)
    if other is None or other.name == slider.name:
        return f"mirror '{slider.mirror}', expected the name of another slider"
    if other.mirror != slider.name:
        return f"mirror '{slider.mirror}', whose mirror is '{other.mirror or ''}', expected them to name each other"
    return None


def sliders_fault(sliders: Sequence[Slider]) -> tuple[str, str] | None:
    """The first slider with damaged curves or a mirror that is not mutual, and what is wrong; None for none."""
    by_name = {slider.name: slider for slider in sliders}
    for slider in sliders:
        twin = by_name.get(slider.mirror or "")
        fault = curves_fault(slider) or mirror_fault(slider, (twin,) if twin else ())
        if fault:
            return slider.name, fault
    return None


def clamped_value(slider: Slider) -> float:
    """The value of a slider, its default where none is authored, within its range.

    :raises InputError: a value that is not finite
    """
    return _clamped(slider, slider.setting)


def _clamped(slider: Slider, value: float) -> float:
    if not np.isfinite(value):
        raise InputError(f"slider {slider.name}", f"value {value}, expected a finite number")
    return min(max(value, slider.minimum), slider.maximum)


def independent(sliders: Sequence[Slider]) -> BoolArray:
    """(s,) whether a slider is needed to reach what all of them can.

    Left out are mixes of others before them, and both sliders of a pair that together do what one does for both sides.
    Sliders with curves are none of these.
    """
    straight = [not (slider.channel_curves or slider.shape_curves) for slider in sliders]
    gains = [
        {**{(joint, channel): gain for joint, channel, gain in slider.channels}, **dict(slider.shapes)}
        for slider in sliders
    ]
    columns = {target: i for i, target in enumerate(dict.fromkeys(target for effect in gains for target in effect))}
    table = np.zeros((len(sliders), len(columns)))
    for row, effect in zip(table, gains, strict=True):
        row[[columns[target] for target in effect]] = list(effect.values())
    effects, names = table, {slider.name: i for i, slider in enumerate(sliders)}
    span: FloatArray = np.zeros((0, effects.shape[1]))
    kept = np.array([not plain for plain in straight])
    for i, slider in enumerate(sliders):
        if straight[i] and slider.mirror is None:
            span, kept[i] = _extended(span, effects[i])
    for i, slider in enumerate(sliders):
        if straight[i] and slider.mirror is not None:
            both = effects[i] + effects[names[slider.mirror]] if slider.mirror in names else effects[i]
            kept[i] = _extended(span, both)[1]
    return kept


def _extended(span: FloatArray, effect: FloatArray) -> tuple[FloatArray, bool]:
    """Orthonormal rows (r, targets) with what an effect adds to them, and whether that is anything."""
    left = effect - (effect @ span.T) @ span
    left -= (left @ span.T) @ span  # twice is enough against rounding
    size = float(np.linalg.norm(left))
    if size <= _NO_EFFECT * float(np.linalg.norm(effect)) or size == 0.0:
        return span, False
    return np.vstack([span, left / size]), True
