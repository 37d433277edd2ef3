"""The learned network of a face's sliders as nodes, beside their ramps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import ExportError
from facepipe.onnx_graph import Nodes
from facepipe.parts import Slider, SliderNetwork
from facepipe.rig import CHANNELS, Rig
from facepipe.rig.slider_network import ACTIVATIONS
from facepipe_onnx.packed_weights import PackedNodes, follow, product_nodes
from facepipe_onnx.ramps import Ramps

_OPERATORS = {"tanh": "Tanh", "relu": "Relu", "silu": "Sigmoid"}


def network_nodes(
    nodes: PackedNodes, rig: Rig, sliders: Sequence[Slider], network: SliderNetwork, ramps: Ramps, risen: str
) -> tuple[Ramps, str]:
    """The ramps with a row of gains more for every unit before the network's last layer, and the values of all rows.

    So one product makes the bone coefficients of both.

    :param ramps: with one over the range of each of the network's sliders
    :param risen: [batch, k] of `ramp_nodes`
    :raises ExportError: a network of an unknown shape
    """
    inputs, weight, bias = _first_layer(network, sliders, ramps)
    layers = [(weight, bias), *zip(network.weights[1:], network.biases[1:], strict=True)]
    units = risen
    if not np.array_equal(inputs, np.arange(len(ramps.starts))):
        units = follow(nodes, nodes.gather(risen, 1, inputs), lambda values: values[:, inputs], risen)
    for matrix, offset in layers[:-1]:
        layer = product_nodes(nodes, units, ("network_weight", "network_bias"), matrix.T, offset)
        units = follow(nodes, _active(nodes, network.activation, layer), ACTIVATIONS[network.activation], layer)
    both = nodes.concat([risen, units], 1)
    follow(nodes, both, lambda *values: np.concatenate(values, axis=1), risen, units)
    return _with_rows(rig, network, ramps, *layers[-1]), both


def _active(nodes: Nodes, activation: str, values: str) -> str:
    found = nodes.add(_OPERATORS[activation], values)
    return nodes.add("Mul", values, found) if activation == "silu" else found


def _first_layer(
    network: SliderNetwork, sliders: Sequence[Slider], ramps: Ramps
) -> tuple[IntArray, FloatArray, FloatArray]:
    """(i,) ramps over the ranges of the network's sliders, and the first layer over their values 0..1.

    Sliders of a single value have no ramp: they are part of the bias.
    """
    by_name = {one.name: (number, one) for number, one in enumerate(sliders)}
    own = [by_name[name] for name in network.sliders]
    lower = np.array([one.minimum for _, one in own])
    reach = np.array([one.maximum for _, one in own]) - lower
    keys = list(zip(ramps.sliders.tolist(), ramps.starts.tolist(), ramps.ends.tolist(), strict=True))
    weight, bias = (np.asarray(one[0], dtype=np.float64) for one in (network.weights, network.biases))
    if not reach.any():
        return np.zeros(1, dtype=np.int64), np.zeros((len(bias), 1)), bias + weight @ lower
    inputs = [keys.index((number, one.minimum, one.maximum)) for number, one in own if one.minimum < one.maximum]
    return np.array(inputs), (weight * reach)[:, reach > 0], bias + weight @ lower


def _with_rows(rig: Rig, network: SliderNetwork, ramps: Ramps, weight: FloatArray, bias: FloatArray) -> Ramps:
    """The ramps with what a last layer (outputs, units) adds."""
    for shape in network.shapes:
        if shape not in rig.shapes:
            raise ExportError(f"{rig.name} -> slider network", f"no shape '{shape}'")
    bones = 9 * len(rig.joints)
    columns = [9 * rig.joints.index(joint) + CHANNELS.index(channel) for joint, channel in network.channels]
    columns += [bones + rig.shapes.index(shape) for shape in network.shapes]
    rows = np.zeros((weight.shape[1], bones + len(rig.shapes)))
    rows[:, columns] = weight.T
    base = np.concatenate([ramps.base, ramps.shape_base])
    base[columns] += bias
    return ramps._replace(
        base=base[:bones],
        gains=np.concatenate([ramps.gains, rows[:, :bones]]),
        shape_base=base[bones:],
        shape_gains=np.concatenate([ramps.shape_gains, rows[:, bones:]]),
    )
