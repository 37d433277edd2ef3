"""The network for first guesses as an ONNX graph, written node by node."""

from __future__ import annotations

import json
from collections.abc import Mapping

import numpy as np

from facepipe.learn.networks.graph_writer import GraphWriter
from facepipe.learn.photo.amortised.losses import POSE_MEAN, POSE_STD
from facepipe.learn.photo.amortised.metadata import KEY
from facepipe.learn.photo.amortised.network import COUNT, SIZE, SPREAD, StartNetwork
from facepipe.learn.photo.pose import NUMBERS

FURTHER_OPERATORS = ("Conv",)  # beside those that every engine has for per-frame graphs


def start_graph(network: StartNetwork, metadata: Mapping[str, object]) -> bytes:
    """The bytes of an ONNX model of any batch, normalisation folded into convolutions.

    Inputs `image` (b, 3, 128, 128) as in the metadata's mean and std, `landmarks` (b, 68, 2) in sides of the crop;
    outputs `shares` (b, f) and `expressions` (b, e) in 0..1, `pose` (b, 7) as `CropSpace`.

    :param metadata: as ``facepipe.photo``
    """
    write = GraphWriter()
    places = _places(write, network)
    picture = _picture(write, network)
    marks = write.relu("placed_last", write.linear("placed_last", _placed(write, network, places), network.placed_last))
    both = write.add("Concat", "both", picture, marks, axis=1)
    inner = write.relu("middle", write.linear("middle", both, network.middle))
    straight = write.add("MatMul", "straight", places, write.constant("straight_weight", network.straight.weight.T))
    values = write.add("Add", "values", write.linear("last", inner, network.last), straight)
    _outputs(write, network, values)
    return _serialised(write, network, metadata)


def _places(write: GraphWriter, network: StartNetwork) -> str:
    off = write.add("Sub", "off", "landmarks", write.constant("template", network.template))
    rows = write.add("Reshape", "off_rows", off, write.shape("off_shape", [-1, 2 * COUNT]))
    return write.add("Mul", "places", rows, write.constant("spread", [1 / SPREAD]))


def _placed(write: GraphWriter, network: StartNetwork, places: str) -> str:
    return write.relu("placed", write.linear("placed", places, network.placed))


def _picture(write: GraphWriter, network: StartNetwork) -> str:
    at = write.relu("stem", write.conv("stem", "image", network.stem, network.stem_norm))
    for number, block in enumerate(network.blocks):
        at = write.block(f"block{number}", at, block)
    squeezed = write.relu("squeeze", write.conv("squeeze", at, network.squeeze))
    rows = write.add("Reshape", "cells", squeezed, write.shape("cells_shape", [-1, network.seen.in_features]))
    return write.relu("seen", write.linear("seen", rows, network.seen))


def _outputs(write: GraphWriter, network: StartNetwork, values: str) -> None:
    """The parts of the last layer, held in 0..1 or in units."""
    sliders, expressions, _ = network.counts
    ends = np.cumsum([0, *network.counts])
    low, high = write.constant("zero", np.zeros(())), write.constant("one", np.ones(()))
    for name, number, count in (("shares", 0, sliders), ("expressions", 1, expressions)):
        own = _slice(write, f"{name}_raw", values, int(ends[number]), int(ends[number + 1]))
        if count:
            write.add("Clip", name, own, low, high)
    scaled = _slice(write, "pose_raw", values, int(ends[2]), int(ends[3]))
    scaled = write.add("Mul", "pose_off", scaled, write.constant("pose_std", POSE_STD))
    write.add("Add", "pose", scaled, write.constant("pose_mean", POSE_MEAN))


def _slice(write: GraphWriter, name: str, source: str, first: int, last: int) -> str:
    """Columns of rows."""
    ends = [write.shape(f"{name}_{part}", [value]) for part, value in (("from", first), ("to", last), ("axis", 1))]
    return write.add("Slice", name, source, *ends)


def _serialised(write: GraphWriter, network: StartNetwork, metadata: Mapping[str, object]) -> bytes:
    sizes = {"shares": network.counts[0], "expressions": network.counts[1], "pose": NUMBERS}
    operators = sorted({node.op_type for node in write.nodes})
    further = [name for name in operators if name in FURTHER_OPERATORS]
    described = {**metadata, "operators": operators, "further_operators": further}
    return write.model(
        "photo_start",
        {"image": (3, SIZE, SIZE), "landmarks": (COUNT, 2)},
        {name: (count,) for name, count in sizes.items() if count},
        {KEY: json.dumps(described, sort_keys=True)},
    )
