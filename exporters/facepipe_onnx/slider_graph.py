"""From the sliders of a rig to an ONNX graph.

Inputs: ``sliders`` [batch, sliders]; ``weights`` [batch, shapes], added to what the sliders drive, if there are shapes;
``parent`` [batch, 4, 4] by option. Outputs, of a face with joints: ``coefficients`` [batch, joints, 9] and
``skinning_matrices`` [batch, joints, 4, 4], world times inverse bind: from skeleton space at bind time to world space,
what a GPU blends by skin weights; ``morph_weights`` [batch, targets], if there are shapes; ``points`` and ``normals``
[batch, points, 3] by option.
Matrices are for column vectors, row by row (the translation is the last column), in stage units.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import ExportError
from facepipe.core.names import select
from facepipe.parts import Slider, SliderNetwork
from facepipe.rig import CHANNELS, Rig, rest_coefficients, slide
from facepipe.rig.sliders import ACTIVATIONS, kept, kept_outputs
from facepipe_onnx.deform import Ends, activation_nodes, chain_nodes, chains_of, end_nodes, normal_nodes, tree_order
from facepipe_onnx.graph import checked_triangles, rigid, select_shapes, skinned
from facepipe_onnx.options import Options
from facepipe_onnx.packed_weights import (
    PackedNodes,
    Ramps,
    follow,
    product_nodes,
    ramp_nodes,
    ramp_samples,
    ramps_of,
    slider_samples,
)

_SAMPLES = 4096  # of slider values, for packed weights
_LARGE = 1 << 14  # numbers: a matrix that is worth two more nodes to make smaller
_OPERATORS = {"tanh": "Tanh", "relu": "Relu", "silu": "Sigmoid"}


def select_driven(
    rig: Rig, sliders: Sequence[Slider], network: SliderNetwork | None, names: tuple[str, ...]
) -> tuple[tuple[Slider, ...], SliderNetwork | None]:
    """Sliders and network without what they do to shapes of the rig that are not in `names`; no network of nothing."""
    left_out = set(rig.shapes) - set(names)
    passes = (lambda _: True, lambda shape: shape not in left_out)
    return tuple(kept(slider, *passes) for slider in sliders), network and kept_outputs(network, *passes)


def build(
    rig: Rig,
    sliders: Sequence[Slider],
    options: Options,
    *,
    network: SliderNetwork | None = None,
    triangles: IntArray | None = None,
) -> Any:
    """The graph of sliders as an `onnx.ModelProto`, without metadata.

    :param network: of the face, which adds to what the sliders do
    :param triangles: (t, 3) point indices; needed for the `normals` option
    :raises InputError: an option out of range, a shape glob that matches nothing, or a slider or network of an unknown
        joint
    :raises ExportError: no sliders, none that moves anything, one of an unknown shape, or more than 2 GB
    """
    options.check()
    if not sliders:
        raise ExportError(rig.name, "no sliders, expected some for the option sliders")
    if options.parent and not (rig.joints or options.points):
        raise ExportError(rig.name, "no joints, expected some, or the option points, for the option parent")
    if options.points and not len(rig.points):
        raise ExportError(rig.name, "no points, expected a mesh for the option points")
    slide(sliders, rig.joints, network=network)  # says what is wrong with them
    names = select(rig.shapes, options.shapes, "shapes")
    sliders, network = select_driven(rig, sliders, network, names)
    rig = select_shapes(rig, names)
    nodes, batch = PackedNodes(options.weights), options.batch
    # a network's input needs its ramp even if the slider itself drives nothing
    ramps = ramps_of(rig, sliders, () if network is None else network.sliders)
    risen = ramp_nodes(nodes, ramps, len(sliders))
    if nodes.weights != "float32":
        found = ramp_samples(ramps, slider_samples(sliders, max(_SAMPLES, 4 * len(ramps.gains)), seed=0))
        nodes.samples[risen] = (found, found)
    if network is not None:
        ramps, risen = _network_nodes(nodes, rig, sliders, network, ramps, risen)
    ends = _joints(nodes, rig, ramps, risen, options) if rig.joints else None
    activations = None
    if rig.targets:
        weights = "weights"  # of the input, and those that the sliders drive
        if ramps.shape_gains.any() or ramps.shape_base.any():
            names_of = ("shape_gains", "shape_base")
            driven = product_nodes(nodes, risen, names_of, ramps.shape_gains, ramps.shape_base)
            weights = nodes.add("Add", driven, weights)
        activations = activation_nodes(nodes, rig, weights, name="morph_weights")
    if options.points and (rig.joints or options.parent):
        skinned(nodes, rig, ends, options, activations)
    elif options.points:
        rigid(nodes, rig, batch, activations)
    if options.normals:
        normal_nodes(nodes, "points", len(rig.points), checked_triangles(rig, triangles), batch)
    return nodes.model("sliders", rig.name, *signature(rig, sliders, options))


def _joints(nodes: PackedNodes, rig: Rig, ramps: Ramps, risen: str, options: Options) -> Ends:
    """The outputs of the joints; returns what multiplies their world matrices with constants."""
    own = ramps.gains.any(axis=0) | (ramps.base != rest_coefficients(len(ramps.base) // 9).ravel())
    chains = chains_of(
        rig, np.asarray(own.reshape(-1, 9).any(axis=1)), np.eye(4) if options.parent else rig.parent_world
    )
    # [batch, n, 9] bone coefficients of the rows of `chains`; those of all joints become an output
    rows, count = len(chains.joints), len(ramps.gains)
    joint_gains = np.concatenate([ramps.gains.reshape(count, -1, 9), np.zeros((count, 1, 9))], axis=1)
    joint_base = np.concatenate([ramps.base.reshape(-1, 9), rest_coefficients(1)])
    gains, base = joint_gains[:, chains.joints].reshape(count, -1), joint_base[chains.joints].ravel()
    moved = gains.any(axis=0)
    if gains.size < _LARGE or 2 * moved.sum() > len(base):
        product = product_nodes(nodes, risen, ("gains", "base"), gains, base)
    else:  # of large gains without the columns that are 0, where they are many
        columns, (still, numbers) = np.flatnonzero(moved), np.unique(base[~moved], return_inverse=True)
        place = np.empty(len(base), dtype=np.int64)
        place[columns], place[~moved] = np.arange(len(columns)), len(columns) + numbers
        own_product = product_nodes(nodes, risen, ("gains", "base"), gains[:, columns], base[columns])
        both = nodes.concat([own_product, nodes.constant("still", np.tile(still, (options.batch, 1)))], 1)
        product = nodes.gather(both, 1, place)
    coefficients = nodes.reshape(product, options.batch, rows, 9)
    nodes.add("Gather", coefficients, nodes.indices(chains.rows), axis=1, name="coefficients")
    worlds = chain_nodes(nodes, chains, coefficients, parent=options.parent, batch=options.batch)
    end_nodes(nodes, chains, worlds, rig.inverse_bind, np.arange(len(rig.joints)), name="skinning_matrices")
    order = tree_order(rig.parents)[0]
    return lambda constants: end_nodes(nodes, chains, worlds, constants, order)


def signature(
    rig: Rig, sliders: Sequence[Slider], options: Options
) -> tuple[dict[str, tuple[int, ...]], dict[str, tuple[int, ...]]]:
    """Names and shapes of the graph's inputs and of its outputs; `rig` holds the exported shapes only."""
    batch, joints = options.batch, len(rig.joints)
    inputs: dict[str, tuple[int, ...]] = {"sliders": (batch, len(sliders))}
    if rig.shapes:
        inputs["weights"] = (batch, len(rig.shapes))
    if options.parent:
        inputs["parent"] = (batch, 4, 4)
    outputs: dict[str, tuple[int, ...]] = {}
    if joints:
        outputs |= {"coefficients": (batch, joints, 9), "skinning_matrices": (batch, joints, 4, 4)}
    if rig.targets:
        outputs["morph_weights"] = (batch, len(rig.targets))
    if options.points:
        outputs["points"] = (batch, len(rig.points), 3)
    if options.normals:
        outputs["normals"] = (batch, len(rig.points), 3)
    return inputs, outputs


def _network_nodes(
    nodes: PackedNodes, rig: Rig, sliders: Sequence[Slider], network: SliderNetwork, ramps: Ramps, risen: str
) -> tuple[Ramps, str]:
    """The ramps with a row of gains more for every unit before the network's last layer, and the values of all rows.

    So one product makes the bone coefficients of both.

    :param ramps: with one over the range of each of the network's sliders
    :param risen: [batch, k] of `ramp_nodes`
    :raises ExportError: a network of an unknown shape
    """
    # x = lower + reach ramp, so W x + b = (W reach) ramp + (b + W lower): the ramp brings the clamp along
    inputs, weight, bias = _first_layer(network, sliders, ramps)
    layers = [(weight, bias), *zip(network.weights[1:], network.biases[1:], strict=True)]
    units = risen
    if not np.array_equal(inputs, np.arange(len(ramps.starts))):
        units = follow(nodes, nodes.gather(risen, 1, inputs), lambda values: values[:, inputs], risen)
    for matrix, offset in layers[:-1]:
        layer = product_nodes(nodes, units, ("network_weight", "network_bias"), matrix.T, offset)
        found = nodes.add(_OPERATORS[network.activation], layer)
        units = follow(
            nodes,
            nodes.add("Mul", layer, found) if network.activation == "silu" else found,
            ACTIVATIONS[network.activation],
            layer,
        )
    both = nodes.concat([risen, units], 1)
    follow(nodes, both, lambda *values: np.concatenate(values, axis=1), risen, units)
    for shape in network.shapes:
        if shape not in rig.shapes:
            raise ExportError(f"{rig.name} -> slider network", f"no shape '{shape}'")
    bones = 9 * len(rig.joints)
    columns = [9 * rig.joints.index(joint) + CHANNELS.index(channel) for joint, channel in network.channels]
    columns += [bones + rig.shapes.index(shape) for shape in network.shapes]
    last, last_bias = layers[-1]
    rows = np.zeros((last.shape[1], bones + len(rig.shapes)))
    rows[:, columns] = last.T
    base = np.concatenate([ramps.base, ramps.shape_base])
    base[columns] += last_bias
    longer = ramps._replace(
        base=base[:bones],
        gains=np.concatenate([ramps.gains, rows[:, :bones]]),
        shape_base=base[bones:],
        shape_gains=np.concatenate([ramps.shape_gains, rows[:, bones:]]),
    )
    return longer, both


def _first_layer(
    network: SliderNetwork, sliders: Sequence[Slider], ramps: Ramps
) -> tuple[IntArray, FloatArray, FloatArray]:
    """(i,) ramps over the ranges of the network's sliders, and the first layer over their values 0..1.

    Sliders of a single value have no ramp: they are part of the bias.
    """
    by_name = {one.name: (number, one) for number, one in enumerate(sliders)}
    inputs_of_network = [by_name[name] for name in network.sliders]
    lower = np.array([one.minimum for _, one in inputs_of_network])
    reach = np.array([one.maximum for _, one in inputs_of_network]) - lower
    keys = list(zip(ramps.sliders.tolist(), ramps.starts.tolist(), ramps.ends.tolist(), strict=True))
    weight, bias = (np.asarray(one[0], dtype=np.float64) for one in (network.weights, network.biases))
    if not reach.any():
        return np.zeros(1, dtype=np.int64), np.zeros((len(bias), 1)), bias + weight @ lower
    inputs = [
        keys.index((number, one.minimum, one.maximum)) for number, one in inputs_of_network if one.minimum < one.maximum
    ]
    return np.array(inputs), (weight * reach)[:, reach > 0], bias + weight @ lower
