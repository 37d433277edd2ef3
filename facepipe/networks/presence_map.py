"""Where in a picture faces may be: the presence of a landmark network in every crop, without its crops.

What a network of convolutions sees in crops that overlap it sees once (Sermanet et al., "OverFeat", ICLR 2014): the
mean over a crop's features becomes a mean over each window of the picture's. At their edges windows see what is beside
them, where crops end, so a window's presence is not exactly that of its crop.
"""

from __future__ import annotations

import math
from typing import Any

_OPERATORS = ("Sigmoid", "Gemm", "Flatten", "GlobalAveragePool")  # from presence back to the features


def presence_map(model: Any) -> tuple[bytes, int]:
    """An ONNX model of presence before its sigmoid (1, 1, r, c), and the pixels between its windows.

    :param model: the `onnx.ModelProto` of a landmark network; of its input (b, 3, S, S) the map takes (1, 3, h, w), at
        least S and multiples of the pixels between windows
    :raises ValueError: its presence is not the sigmoid of a layer of mean features
    """
    from onnx import ModelProto, TensorProto, helper, shape_inference

    made = {output: node for node in model.graph.node for output in node.output}
    steps, name = [], "presence"
    for operator in _OPERATORS:
        if name not in made or made[name].op_type != operator:
            raise ValueError(f"{name} is not of {operator}")
        steps.append(made[name])
        name = steps[-1].input[0]
    _, weight, bias = steps[1].input
    shapes = {one.name: one for one in shape_inference.infer_shapes(model).graph.value_info}
    window = shapes[name].type.tensor_type.shape.dim[2].dim_value
    size = model.graph.input[0].type.tensor_type.shape.dim[2].dim_value
    if window < 1 or size % window:
        raise ValueError(f"features of {window} rows, of a crop of {size}")
    result = ModelProto()
    result.CopyFrom(model)
    graph = result.graph
    kernel = next((one for one in graph.initializer if one.name == weight), None)
    if kernel is None:
        raise ValueError(f"{weight} is no constant")
    kernel.dims[:] = [1, math.prod(kernel.dims), 1, 1]
    nodes = _before(model.graph, name)
    nodes.append(helper.make_node("AveragePool", [name], ["mean"], kernel_shape=[window, window]))
    nodes.append(helper.make_node("Conv", ["mean", weight, bias], ["map"]))
    del graph.node[:], graph.output[:]
    graph.node.extend(nodes)
    graph.output.append(helper.make_tensor_value_info("map", TensorProto.FLOAT, None))
    for axis, length in zip(graph.input[0].type.tensor_type.shape.dim[2:], ("height", "width"), strict=True):
        axis.dim_param = length
    return result.SerializeToString(), size // window


def _before(graph: Any, name: str) -> list[Any]:
    """The nodes that make `name`."""
    wanted, nodes = {name}, []
    for node in reversed(graph.node):
        if wanted & set(node.output):
            wanted |= set(node.input)
            nodes.append(node)
    return nodes[::-1]
