"""Learned networks, which add to bone coefficients and shape weights from the values of several sliders."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.parts import Slider, SliderNetwork
from facepipe.rig.bone_coefficients import CHANNELS


def _silu(values: FloatArray) -> FloatArray:
    from scipy.special import expit  # a tenth of a second, which few faces need

    return np.asarray(values * expit(values))


ACTIVATIONS: Mapping[str, Callable[[FloatArray], FloatArray]] = {
    "tanh": np.tanh,
    "relu": lambda values: np.maximum(values, 0.0),
    "silu": _silu,
}


def evaluate(network: SliderNetwork, values: FloatArray) -> FloatArray:
    """(..., outputs) of (..., inputs) clamped slider values: those of the channels, then those of the shapes."""
    layer: FloatArray = np.asarray(values, dtype=np.float64)
    for number, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        if number:
            layer = ACTIVATIONS[network.activation](layer)
        layer = layer @ np.asarray(weight, dtype=np.float64).T + bias
    return layer


def add_network(
    network: SliderNetwork,
    joints: Sequence[str],
    values: Mapping[str, float],
    coefficients: FloatArray,
    weights: dict[str, float],
) -> None:
    """Add what a network gives to bone coefficients (j, 9) and shape weights.

    :param values: of all sliders, clamped
    :raises InputError: a damaged network, or one of a slider, joint or channel that is not there
    """
    check_network(network, values, joints)
    amounts = evaluate(network, np.array([values[name] for name in network.sliders]))
    index = {joint: i for i, joint in enumerate(joints)}
    for (joint, channel), amount in zip(network.channels, amounts, strict=False):
        coefficients[index[joint], CHANNELS.index(channel)] += amount
    for shape, amount in zip(network.shapes, amounts[len(network.channels) :], strict=True):
        weights[shape] = weights.get(shape, 0.0) + float(amount)


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
        weights = evaluate(network, values)[..., len(network.channels) :]
        if network.weights[0][:, number].any():
            changes[name] = dict(zip(network.shapes, np.ptp(weights, axis=1).max(axis=0).tolist(), strict=True))
    return changes


def kept(network: SliderNetwork, joint: Callable[[str], bool], shape: Callable[[str], bool]) -> SliderNetwork | None:
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
