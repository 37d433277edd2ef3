"""Reads ONNX files of others: whole, self-contained, of operator sets whose meaning is known."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from facepipe.core.arrays import AnyArray
from facepipe.core.errors import InputError
from facepipe.core.reading import read_bytes
from facepipe.onnx_graph import MAX_BYTES

OLDEST_OPSET, NEWEST_OPSET = 7, 25

_DOMAINS = ("", "ai.onnx")


def read_model(path: Path) -> Any:
    """The `onnx.ModelProto` in a file. Only its outside is checked: its nodes are checked by whoever runs them.

    :raises InputError: not readable, truncated, no ONNX, data in other files, or another operator set
    """
    import onnx

    model = onnx.ModelProto()
    try:
        model.ParseFromString(read_bytes(path, MAX_BYTES))
    except InputError:
        raise
    except Exception as error:  # protobuf's errors share no other base
        raise InputError(path, "is damaged or no ONNX file") from error
    if not model.HasField("graph") or not len(model.graph.node):
        raise InputError(path, "is no ONNX file, or one without a graph")
    for what in _faults(model):
        raise InputError(path, what)
    return model


def opset(model: Any) -> int:
    """Version of the default operator set."""
    return next(int(one.version) for one in model.opset_import if one.domain in _DOMAINS)


def properties(model: Any) -> dict[str, str]:
    """Its metadata by key."""
    return {prop.key: prop.value for prop in model.metadata_props}


def array(tensor: Any) -> AnyArray:
    """The values of an `onnx.TensorProto`.

    :raises InputError: data elsewhere, not as many as its shape says, or NaN
    """
    from onnx import numpy_helper

    where = f"tensor {tensor.name!r}"
    if tensor.data_location or len(tensor.external_data):
        raise InputError(where, "data in another file, expected it inside (onnx.save_model with one file)")
    try:
        values = np.array(numpy_helper.to_array(tensor))
    except Exception as error:  # of onnx: ValueError, TypeError and errors of its own
        raise InputError(where, f"can't be read ({error})") from error
    if values.dtype.kind not in "fiub" or values.dtype.name == "bfloat16":
        raise InputError(where, f"of type {values.dtype}, expected floats, integers or booleans")
    if values.dtype.kind == "f" and np.isnan(values).any():
        raise InputError(where, "holds NaN, expected numbers")
    return values


def _faults(model: Any) -> Iterator[str]:
    graph = model.graph
    names = [*graph.initializer, *graph.input, *graph.output, *graph.node]
    texts = [name.name for name in names] + [text for node in graph.node for text in (*node.input, *node.output)]
    if not all(isinstance(text, str) for text in texts):
        yield "names that are not UTF-8, expected text"
    versions = [one.version for one in model.opset_import if one.domain in _DOMAINS]
    if len(versions) != 1 or not OLDEST_OPSET <= versions[0] <= NEWEST_OPSET:
        yield f"operator set {versions[:3]}, expected one from {OLDEST_OPSET} to {NEWEST_OPSET}"
    if len(graph.sparse_initializer):
        yield "sparse tensors, expected dense ones"
    for tensor in (one for each in (graph, *model.functions) for one in _tensors(each)):
        if tensor.data_location or len(tensor.external_data):
            yield f"tensor {tensor.name!r} has its data in another file, expected one file (onnx.save_model)"


def _tensors(graph: Any) -> Iterator[Any]:
    """All of a graph or function, of its nodes and of graphs within them."""
    yield from getattr(graph, "initializer", ())
    for attribute in (one for node in graph.node for one in node.attribute):
        yield from (attribute.t, *attribute.tensors)
        for inner in (attribute.g, *attribute.graphs):
            yield from _tensors(inner)
