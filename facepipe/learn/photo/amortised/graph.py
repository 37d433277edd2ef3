"""The network for first guesses as an ONNX graph, written node by node."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import nn

from facepipe.learn.networks.landmark_network import Block
from facepipe.learn.photo.amortised.losses import POSE_MEAN, POSE_STD
from facepipe.learn.photo.amortised.metadata import KEY
from facepipe.learn.photo.amortised.network import COUNT, SIZE, SPREAD, StartNetwork
from facepipe.learn.photo.pose import NUMBERS

OPSET, IR_VERSION = 15, 8
FURTHER_OPERATORS = ("Conv",)  # beside those that every engine has for per-frame graphs


def start_graph(network: StartNetwork, metadata: Mapping[str, object]) -> bytes:
    """The bytes of an ONNX model of any batch, normalisation folded into convolutions.

    Inputs `image` (b, 3, 128, 128) as in the metadata's mean and std, `landmarks` (b, 68, 2) in sides of the crop;
    outputs `shares` (b, f) and `expressions` (b, e) in 0..1, `pose` (b, 7) as `CropSpace`.

    :param metadata: as ``facepipe.photo``
    """
    write = _Writer()
    places = _places(write, network)
    picture = _picture(write, network)
    marks = write.relu("placed_last", write.linear("placed_last", _placed(write, network, places), network.placed_last))
    both = write.add("Concat", "both", picture, marks, axis=1)
    inner = write.relu("middle", write.linear("middle", both, network.middle))
    straight = write.add("MatMul", "straight", places, write.constant("straight_weight", network.straight.weight.T))
    values = write.add("Add", "values", write.linear("last", inner, network.last), straight)
    _outputs(write, network, values)
    return _serialised(write, network, metadata)


def _places(write: _Writer, network: StartNetwork) -> str:
    off = write.add("Sub", "off", "landmarks", write.constant("template", network.template))
    rows = write.add("Reshape", "off_rows", off, write.shape("off_shape", [-1, 2 * COUNT]))
    return write.add("Mul", "places", rows, write.constant("spread", [1 / SPREAD]))


def _placed(write: _Writer, network: StartNetwork, places: str) -> str:
    return write.relu("placed", write.linear("placed", places, network.placed))


def _picture(write: _Writer, network: StartNetwork) -> str:
    at = write.relu("stem", write.conv("stem", "image", network.stem, network.stem_norm))
    for number, block in enumerate(network.blocks):
        at = write.block(f"block{number}", at, block)
    squeezed = write.relu("squeeze", write.conv("squeeze", at, network.squeeze))
    rows = write.add("Reshape", "cells", squeezed, write.shape("cells_shape", [-1, network.seen.in_features]))
    return write.relu("seen", write.linear("seen", rows, network.seen))


def _outputs(write: _Writer, network: StartNetwork, values: str) -> None:
    """The parts of the last layer, held in 0..1 or in units."""
    sliders, expressions, _ = network.counts
    ends = np.cumsum([0, *network.counts])
    low, high = write.constant("zero", np.zeros(())), write.constant("one", np.ones(()))
    for name, number, count in (("shares", 0, sliders), ("expressions", 1, expressions)):
        own = write.slice(f"{name}_raw", values, int(ends[number]), int(ends[number + 1]))
        if count:
            write.add("Clip", name, own, low, high)
    scaled = write.slice("pose_raw", values, int(ends[2]), int(ends[3]))
    scaled = write.add("Mul", "pose_off", scaled, write.constant("pose_std", POSE_STD))
    write.add("Add", "pose", scaled, write.constant("pose_mean", POSE_MEAN))


class _Writer:
    """Nodes and constants as they come."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def constant(self, name: str, values: Any) -> str:
        array = np.asarray(values.detach() if isinstance(values, torch.Tensor) else values, dtype=np.float32)
        self.constants.append(numpy_helper.from_array(np.array(array, order="C"), name))
        return name

    def shape(self, name: str, values: list[int]) -> str:
        self.constants.append(numpy_helper.from_array(np.array(values, dtype=np.int64), name))
        return name

    def add(self, kind: str, name: str, *inputs: str, **attributes: object) -> str:
        self.nodes.append(helper.make_node(kind, list(inputs), [name], name=name, **attributes))
        return name

    def relu(self, name: str, source: str) -> str:
        return self.add("Relu", f"{name}_relu", source)

    def slice(self, name: str, source: str, first: int, last: int) -> str:
        ends = [self.shape(f"{name}_{part}", [value]) for part, value in (("from", first), ("to", last), ("axis", 1))]
        return self.add("Slice", name, source, *ends)

    def linear(self, name: str, source: str, layer: nn.Linear) -> str:
        inputs = (self.constant(f"{name}_weight", layer.weight), self.constant(f"{name}_bias", layer.bias))
        return self.add("Gemm", name, source, *inputs, transB=1)

    def conv(self, name: str, source: str, conv: nn.Conv2d, norm: nn.BatchNorm2d | None = None) -> str:
        """A convolution with the normalisation after it folded in."""
        weight = conv.weight.detach().double()
        bias = torch.zeros(len(weight)) if conv.bias is None else conv.bias.detach().double()
        if norm is not None:
            scale = norm.weight.detach().double() / (norm.running_var.double() + norm.eps).sqrt()
            weight = weight * scale[:, None, None, None]
            bias = norm.bias.detach().double() + (bias - norm.running_mean.double()) * scale
        inputs = (self.constant(f"{name}_weight", weight), self.constant(f"{name}_bias", bias))
        return self.add("Conv", name, source, *inputs, strides=list(conv.stride), pads=[*conv.padding, *conv.padding])

    def block(self, name: str, source: str, block: Block) -> str:
        inner = self.relu(f"{name}_first", self.conv(f"{name}_first", source, block.first, block.first_norm))
        inner = self.conv(f"{name}_second", inner, block.second, block.second_norm)
        beside = source if block.shortcut is None else self.conv(f"{name}_shortcut", source, block.shortcut)
        return self.relu(name, self.add("Add", f"{name}_sum", inner, beside))


def _serialised(write: _Writer, network: StartNetwork, metadata: Mapping[str, object]) -> bytes:
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, ["batch", 3, SIZE, SIZE])
    marks = helper.make_tensor_value_info("landmarks", TensorProto.FLOAT, ["batch", COUNT, 2])
    sizes = {"shares": network.counts[0], "expressions": network.counts[1], "pose": NUMBERS}
    outputs = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", count])
        for name, count in sizes.items()
        if count
    ]
    graph = helper.make_graph(write.nodes, "photo_start", [image, marks], outputs, write.constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="facepipe")
    model.ir_version = IR_VERSION
    operators = sorted({node.op_type for node in write.nodes})
    further = [name for name in operators if name in FURTHER_OPERATORS]
    described = {**metadata, "operators": operators, "further_operators": further}
    helper.set_model_props(model, {KEY: json.dumps(described, sort_keys=True)})
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString(deterministic=True))
