"""The landmark network as an ONNX file, written node by node: no paths of the machine, an opset that engines read."""

from __future__ import annotations

import json
from collections.abc import Mapping

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import nn

from facepipe.learn.networks.landmark_network import COUNT, SIZE, Block, LandmarkNetwork

_OPSET, _IR_VERSION = 15, 8


class _Writer:
    """Nodes and constants as they come."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def constant(self, name: str, values: object, dtype: type = np.float32) -> str:
        self.constants.append(numpy_helper.from_array(np.ascontiguousarray(np.asarray(values, dtype)), name))
        return name

    def add(self, kind: str, name: str, *inputs: str, **attributes: object) -> str:
        self.nodes.append(helper.make_node(kind, list(inputs), [name], name=name, **attributes))
        return name

    def conv(self, name: str, source: str, conv: nn.Conv2d, norm: nn.BatchNorm2d | None = None) -> str:
        """A convolution with the normalisation after it folded in."""
        weight = conv.weight.detach().double()
        bias = torch.zeros(len(weight)) if conv.bias is None else conv.bias.detach().double()
        if norm is not None:
            scale = norm.weight.detach().double() / (norm.running_var.double() + norm.eps).sqrt()
            weight = weight * scale[:, None, None, None]
            bias = norm.bias.detach().double() + (bias - norm.running_mean.double()) * scale
        inputs = (self.constant(f"{name}_weight", weight.numpy()), self.constant(f"{name}_bias", bias.numpy()))
        padding = [*conv.padding, *conv.padding]
        return self.add("Conv", name, source, *inputs, strides=list(conv.stride), pads=padding)

    def block(self, name: str, source: str, block: Block) -> str:
        inner = self.conv(f"{name}_first", source, block.first, block.first_norm)
        inner = self.conv(f"{name}_second", self.add("Relu", f"{name}_relu", inner), block.second, block.second_norm)
        beside = source if block.shortcut is None else self.conv(f"{name}_shortcut", source, block.shortcut)
        return self.add("Relu", f"{name}_out", self.add("Add", f"{name}_sum", inner, beside))

    def stage(self, name: str, source: str, blocks: nn.Sequential) -> str:
        for i, block in enumerate(blocks):
            source = self.block(f"{name}{i}", source, block)
        return source

    def double(self, name: str, source: str) -> str:
        scales = self.constant(f"{name}_scales", [1, 1, 2, 2])
        modes = {"mode": "nearest", "coordinate_transformation_mode": "asymmetric", "nearest_mode": "floor"}
        return self.add("Resize", name, source, "", scales, **modes)


def to_onnx(network: LandmarkNetwork, metadata: Mapping[str, object]) -> bytes:
    """The bytes of an ONNX model; `metadata` as ``facepipe.features``."""
    write = _Writer()
    stem = write.add("Relu", "stem_relu", write.conv("stem", "image", network.stem, network.stem_norm))
    quarter = write.stage("quarter", stem, network.quarter)
    eighth = write.stage("eighth", quarter, network.eighth)
    deep = write.stage("sixteenth", eighth, network.sixteenth)
    sides = [write.conv(f"lateral{i}", at, network.laterals[i]) for i, at in enumerate((quarter, eighth, deep))]
    up = write.add("Add", "up_eighth_in", write.double("double_deep", sides[2]), sides[1])
    up = write.block("up_eighth", up, network.up_eighth)
    up = write.add("Add", "up_quarter_in", write.double("double_eighth", up), sides[0])
    heat = write.conv("heat", write.block("up_quarter", up, network.up_quarter), network.heat)
    shape = write.constant("heat_shape", [0, COUNT, -1], np.int64)
    share = write.add("Softmax", "share", write.add("Reshape", "heat_rows", heat, shape), axis=2)
    write.add("MatMul", "landmarks", share, write.constant("cells", network.cells.numpy()))
    pooled = write.add("Flatten", "pooled_row", write.add("GlobalAveragePool", "pooled", deep), axis=1)
    weight = write.constant("presence_weight", network.presence.weight.detach().numpy())
    bias = write.constant("presence_bias", network.presence.bias.detach().numpy())
    write.add("Sigmoid", "presence", write.add("Gemm", "presence_logit", pooled, weight, bias, transB=1))
    return _serialised(write, metadata)


def _serialised(write: _Writer, metadata: Mapping[str, object]) -> bytes:
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, ["batch", 3, SIZE, SIZE])
    outputs = [
        helper.make_tensor_value_info("landmarks", TensorProto.FLOAT, ["batch", COUNT, 2]),
        helper.make_tensor_value_info("presence", TensorProto.FLOAT, ["batch", 1]),
    ]
    graph = helper.make_graph(write.nodes, "landmarks", [image], outputs, write.constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", _OPSET)], producer_name="facepipe")
    model.ir_version = _IR_VERSION
    helper.set_model_props(model, {"facepipe.features": json.dumps(metadata, sort_keys=True)})
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString(deterministic=True))
