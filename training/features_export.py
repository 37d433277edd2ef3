"""The network as an ONNX file, written node by node: torch's own exporter leaks source paths and picks a newer IR."""

from __future__ import annotations

import json
import operator
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import onnx
import torch
from features_network import OUTPUTS, SIZE
from onnx import TensorProto, helper, numpy_helper
from torch import fx, nn
from torch.fx.experimental.optimization import fuse
from torch.nn import functional

OPSET, IR_VERSION = 15, 8


def to_onnx(network: nn.Module, metadata: Mapping[str, object]) -> bytes:
    """The bytes of the file: normalisation folded into convolutions, any batch, `metadata` as ``facepipe.features``."""
    graph = _Graph(fuse(network.eval()))
    shapes = [tuple(one.shape) for one in network(torch.zeros(1, 3, SIZE, SIZE))]
    outputs = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", *shape[1:]])
        for name, shape in zip(OUTPUTS, shapes, strict=True)
    ]
    source = helper.make_tensor_value_info("image", TensorProto.FLOAT, ["batch", 3, SIZE, SIZE])
    made = helper.make_graph(graph.nodes, "face_features", [source], outputs, graph.constants)
    model = helper.make_model(made, opset_imports=[helper.make_opsetid("", OPSET)])
    model.ir_version, model.producer_name = IR_VERSION, "facepipe"
    helper.set_model_props(model, {"facepipe.features": json.dumps(metadata)})
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString(deterministic=True))


class _Graph:
    """ONNX nodes and constants of a traced module."""

    def __init__(self, traced: fx.GraphModule) -> None:
        self.nodes: list[Any] = []
        self.constants: list[Any] = []
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
            self.add(node, "Relu")
        elif isinstance(module, nn.Conv2d):
            assert module.bias is not None
            tensors = [self.constant(f"{node.name}.{part}", getattr(module, part)) for part in ("weight", "bias")]
            self.add(node, "Conv", *tensors, strides=list(module.stride), pads=[*module.padding, *module.padding])  # type: ignore[misc]
        elif isinstance(module, nn.Linear):
            tensors = [self.constant(f"{node.name}.{part}", getattr(module, part)) for part in ("weight", "bias")]
            self.add(node, "Gemm", *tensors, transB=1)
        else:
            raise TypeError(f"{type(module).__name__} has no ONNX counterpart here")

    def constant(self, name: str, values: Any) -> str:
        """A float32 constant."""
        array = np.asarray(values.detach() if isinstance(values, torch.Tensor) else values, dtype=np.float32)
        self.constants.append(numpy_helper.from_array(np.ascontiguousarray(array), name))
        return name

    def add(self, node: fx.Node, kind: str, *more: str, **attributes: Any) -> None:
        """`kind` applied to the node's inputs, then to the constants `more`."""
        name = self._names[node] = self._ends.get(node, f"{node.name}.values")
        inputs = [self._names[one] for one in node.all_input_nodes]
        self.nodes.append(helper.make_node(kind, [*inputs, *more], [name], **attributes))

    def resize(self, node: fx.Node) -> None:
        """Twice the size, bilinear between pixel centres."""
        assert node.kwargs["scale_factor"] == 2.0
        assert node.kwargs["mode"] == "bilinear"
        name = f"{node.name}.scales"
        self.constant(name, [1, 1, 2, 2])
        self.add(node, "Resize", "", name, mode="linear", coordinate_transformation_mode="half_pixel")

    def flatten(self, node: fx.Node) -> None:
        """All dimensions from one on as one."""
        if node.args[1] == 1:
            self.add(node, "Flatten", axis=1)
        else:
            name = f"{node.name}.shape"
            self.constants.append(numpy_helper.from_array(np.array([0] * int(node.args[1]) + [-1]), name))  # type: ignore[arg-type]
            self.add(node, "Reshape", name)

    def normalize(self, node: fx.Node) -> None:
        """Unit length along the channels."""
        before, length = self._names[node.all_input_nodes[0]], f"{node.name}.length"
        self.nodes.append(helper.make_node("ReduceL2", [before], [length], axes=[1], keepdims=1))
        self.add(node, "Div", length)


_CALLS: Mapping[Any, Callable[[_Graph, fx.Node], None]] = {
    operator.add: lambda graph, node: graph.add(node, "Add"),
    operator.sub: lambda graph, node: graph.add(node, "Sub"),
    operator.mul: lambda graph, node: graph.add(node, "Mul"),
    operator.matmul: lambda graph, node: graph.add(node, "MatMul"),
    functional.interpolate: _Graph.resize,
    functional.normalize: _Graph.normalize,
    "flatten": _Graph.flatten,
    "softmax": lambda graph, node: graph.add(node, "Softmax", axis=node.args[1]),
    "sigmoid": lambda graph, node: graph.add(node, "Sigmoid"),
}
