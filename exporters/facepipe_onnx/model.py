"""Nodes as an ONNX model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from facepipe import __version__
from facepipe.core.errors import ExportError
from facepipe_onnx.nodes import Nodes
from facepipe_onnx.operators import IR_VERSION, MAX_BYTES, OPSET

Shapes = Mapping[str, tuple[int, ...]]


def make_model(nodes: Nodes, name: str, where: str, inputs: Shapes, outputs: Shapes) -> Any:
    """The `onnx.ModelProto`, without metadata.

    :param name: of the graph
    :param where: the face, for messages
    :raises ExportError: numbers beyond float32 (or float16), or more than the 2 GB that a file can hold
    """
    from onnx import TensorProto, helper, numpy_helper

    total = sum(values.nbytes for values in nodes.constants.values())
    if total > MAX_BYTES - (1 << 20):
        raise ExportError(where, f"{total} bytes of tensors, expected less than the 2 GB that an ONNX file holds")
    for constant, values in nodes.constants.items():
        if not np.isfinite(values).all():
            raise ExportError(
                f"{where} -> {constant}", f"values beyond the range of {values.dtype}, expected finite numbers"
            )
    ends = [
        [helper.make_tensor_value_info(end, TensorProto.FLOAT, shape) for end, shape in side.items()]
        for side in (inputs, outputs)
    ]
    tensors = [numpy_helper.from_array(values, constant) for constant, values in nodes.constants.items()]
    graph = helper.make_graph(nodes.nodes, name, *ends, tensors)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)])
    model.ir_version = IR_VERSION
    model.producer_name, model.producer_version = "facepipe", __version__
    return model
