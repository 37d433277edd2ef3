"""ONNX graphs of trained networks, written node by node: no paths of the machine, an opset that engines read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import nn

from facepipe.learn.networks.landmark_network import Block

OPSET, IR_VERSION = 15, 8


class GraphWriter:
    """Nodes and constants as they come; each gives the name of its value."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def constant(self, name: str, values: Any) -> str:
        """Numbers as float32."""
        array = np.asarray(values.detach() if isinstance(values, torch.Tensor) else values, dtype=np.float32)
        self.constants.append(numpy_helper.from_array(np.array(array, order="C"), name))
        return name

    def shape(self, name: str, values: Sequence[int]) -> str:
        """Whole numbers: shapes and places."""
        self.constants.append(numpy_helper.from_array(np.array(values, dtype=np.int64), name))
        return name

    def add(self, kind: str, name: str, *inputs: str, **attributes: object) -> str:
        """A node of one output, both called `name`."""
        self.nodes.append(helper.make_node(kind, list(inputs), [name], name=name, **attributes))
        return name

    def relu(self, name: str, source: str) -> str:
        """What is positive of a value, as `name`_relu."""
        return self.add("Relu", f"{name}_relu", source)

    def linear(self, name: str, source: str, layer: nn.Linear) -> str:
        """A layer of all inputs."""
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
        """A residual block, as `name`_relu."""
        inner = self.relu(f"{name}_first", self.conv(f"{name}_first", source, block.first, block.first_norm))
        inner = self.conv(f"{name}_second", inner, block.second, block.second_norm)
        beside = source if block.shortcut is None else self.conv(f"{name}_shortcut", source, block.shortcut)
        return self.relu(name, self.add("Add", f"{name}_sum", inner, beside))

    def model(
        self,
        name: str,
        inputs: Mapping[str, Sequence[int]],
        outputs: Mapping[str, Sequence[int]],
        properties: Mapping[str, str],
    ) -> bytes:
        """The bytes of a model of any batch, the same for the same nodes.

        :param inputs: name -> shape without the batch
        :param properties: its metadata
        """
        first, last = (
            [helper.make_tensor_value_info(one, TensorProto.FLOAT, ["batch", *shape]) for one, shape in ends.items()]
            for ends in (inputs, outputs)
        )
        graph = helper.make_graph(self.nodes, name, first, last, self.constants)
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="facepipe")
        model.ir_version = IR_VERSION
        helper.set_model_props(model, dict(properties))
        onnx.checker.check_model(model, full_check=True)
        return bytes(model.SerializeToString(deterministic=True))
