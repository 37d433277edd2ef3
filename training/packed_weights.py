"""Trained networks in few bytes: weights as whole numbers of a byte in the file, float32 in a session.

Casts and products of constants are folded when onnxruntime loads the file, so that running costs what it did.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

_LARGE = 1000  # numbers
_MOST = 127


def packed(data: bytes) -> bytes:
    """The bytes of an ONNX model whose weights of convolutions (o, i, h, w) are ``int8 * scale`` with a scale for each
    of o, and whose other large tensors are float16."""
    model = onnx.load_from_string(data)
    graph, nodes = model.graph, []
    for tensor in list(graph.initializer):
        values = numpy_helper.to_array(tensor)
        if tensor.data_type != TensorProto.FLOAT or values.size < _LARGE:
            continue
        name = tensor.name
        if values.ndim == 4:
            scale = np.abs(values).max(axis=(1, 2, 3), keepdims=True) / _MOST
            whole = np.rint(values / np.maximum(scale, np.finfo(np.float32).tiny)).astype(np.int8)
            graph.initializer.append(numpy_helper.from_array(whole, f"{name}.whole"))
            graph.initializer.append(numpy_helper.from_array(scale.astype(np.float32), f"{name}.scale"))
            nodes.append(_node("Cast", f"{name}.float", f"{name}.whole", to=TensorProto.FLOAT))
            nodes.append(_node("Mul", name, f"{name}.float", f"{name}.scale"))
        else:
            graph.initializer.append(numpy_helper.from_array(values.astype(np.float16), f"{name}.half"))
            nodes.append(_node("Cast", name, f"{name}.half", to=TensorProto.FLOAT))
        graph.initializer.remove(tensor)
    nodes.extend(graph.node)
    del graph.node[:]
    graph.node.extend(nodes)
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString(deterministic=True))


def _node(operator: str, output: str, *inputs: str, **attributes: Any) -> Any:
    return helper.make_node(operator, list(inputs), [output], name=f"node_{output}", **attributes)
