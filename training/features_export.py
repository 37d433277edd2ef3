"""The network as an ONNX file, written node by node: torch's own exporter leaks source paths and picks a newer IR."""

from __future__ import annotations

import json
import operator
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from features_network import OUTPUTS, SIZE
from torch import fx, nn
from torch.fx.experimental.optimization import fuse
from torch.nn import functional

from facepipe.rig.torch.graph_writer import GraphWriter


def to_onnx(network: nn.Module, metadata: Mapping[str, object]) -> bytes:
    """The bytes of the file: normalisation folded into convolutions, any batch, `metadata` as ``facepipe.features``."""
    graph = _Graph(fuse(network.eval()))
    given = network(torch.zeros(1, 3, SIZE, SIZE))
    outputs = {name: tuple(one.shape[1:]) for name, one in zip(OUTPUTS, given, strict=True)}
    properties = {"facepipe.features": json.dumps(metadata)}
    return graph.to_bytes("face_features", {"image": (3, SIZE, SIZE)}, outputs, properties)


class _Graph(GraphWriter):
    """A traced module."""

    def __init__(self, traced: fx.GraphModule) -> None:
        super().__init__()
        self._modules, self._buffers = dict(traced.named_modules()), dict(traced.named_buffers())
        self._names: dict[fx.Node, str] = {}
        ends = next(node for node in traced.graph.nodes if node.op == "output").args[0]
        self._ends = dict(zip(ends, OUTPUTS, strict=True))
        for node in traced.graph.nodes:
            self._translate(node)

    def _translate(self, node: fx.Node) -> None:
        if node.op == "placeholder":
            self._names[node] = "image"
        elif node.op == "get_attr":
            self._names[node] = self.constant(node.name, self._buffers[str(node.target)])
        elif node.op == "call_module":
            self._module(node, self._modules[str(node.target)])
        elif node.op != "output":
            _CALLS[node.target](self, node)

    def _module(self, node: fx.Node, module: nn.Module) -> None:
        if isinstance(module, nn.Identity):
            self._names[node] = self._names[node.all_input_nodes[0]]
        elif isinstance(module, nn.ReLU):
            self.apply(node, "Relu")
        elif isinstance(module, nn.Conv2d):
            self._names[node] = self.conv(self._name(node), self._names[node.all_input_nodes[0]], module)
        elif isinstance(module, nn.Linear):
            self._names[node] = self.linear(self._name(node), self._names[node.all_input_nodes[0]], module)
        else:
            raise TypeError(f"{type(module).__name__} has no ONNX counterpart here")

    def apply(self, node: fx.Node, kind: str, *more: str, **attributes: Any) -> None:
        """`kind` applied to the node's inputs, then to the constants `more`."""
        inputs = [self._names[input_node] for input_node in node.all_input_nodes]
        self._names[node] = self.add(kind, *inputs, *more, name=self._name(node), **attributes)

    def _name(self, node: fx.Node) -> str:
        return self._ends.get(node, f"{node.name}.values")

    def resize(self, node: fx.Node) -> None:
        """Twice the size, bilinear between pixel centres."""
        assert node.kwargs["scale_factor"] == 2.0
        assert node.kwargs["mode"] == "bilinear"
        scales = self.constant("scales", np.array([1, 1, 2, 2]))
        self.apply(node, "Resize", "", scales, mode="linear", coordinate_transformation_mode="half_pixel")

    def flatten(self, node: fx.Node) -> None:
        """All dimensions from one on as one."""
        if node.args[1] == 1:
            self.apply(node, "Flatten", axis=1)
        else:
            self.apply(node, "Reshape", self.indices([0] * int(node.args[1]) + [-1]))  # type: ignore[arg-type]

    def normalize(self, node: fx.Node) -> None:
        """Unit length along the channels."""
        before = self._names[node.all_input_nodes[0]]
        self.apply(node, "Div", self.add("ReduceL2", before, axes=[1], keepdims=1))


_CALLS: Mapping[Any, Callable[[_Graph, fx.Node], None]] = {
    operator.add: lambda graph, node: graph.apply(node, "Add"),
    operator.sub: lambda graph, node: graph.apply(node, "Sub"),
    operator.mul: lambda graph, node: graph.apply(node, "Mul"),
    operator.matmul: lambda graph, node: graph.apply(node, "MatMul"),
    functional.interpolate: _Graph.resize,
    functional.normalize: _Graph.normalize,
    "flatten": _Graph.flatten,
    "softmax": lambda graph, node: graph.apply(node, "Softmax", axis=node.args[1]),
    "sigmoid": lambda graph, node: graph.apply(node, "Sigmoid"),
}
