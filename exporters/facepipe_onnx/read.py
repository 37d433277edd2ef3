"""Reads an ONNX file of unknown origin and finds what keeps it, or its sidecar, from being a graph of facepipe.

Nothing is handed to onnx's checker or to onnxruntime before its parts have been found to be plain: tensors inside the
file, of the size their shape says, no subgraphs, no custom operators.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from facepipe.core.errors import InputError
from facepipe.core.reading import file_beside, read_bytes
from facepipe.core.reports import Finding
from facepipe.onnx_graph import IR_VERSION, MAX_BYTES, OPSET
from facepipe_onnx.metadata import (
    FURTHER,
    PER_FRAME,
    TYPES,
    metadata_faults,
    model_metadata,
    parse_json,
    shape_of,
    sidecar_path,
)

FREE_ELEMENTS, PER_BYTE = 1 << 26, 32  # that one evaluation may make: these, and as many for each byte of the weights
_MAX_WHOLE = 1 << 16  # of these, whole numbers: they are shapes, of which readers keep each size as an object
_MAX_NODES = 10_000

_INT64 = 7  # TensorProto.INT64
_PLAIN_ATTRIBUTES = {1, 2, 6, 7}  # AttributeProto.FLOAT, INT, FLOATS, INTS


class Problem(NamedTuple):
    """What is wrong with a model."""

    check: str
    where: str
    message: str


def read(path: Path) -> Any:
    """The `onnx.ModelProto` in a file, unchecked.

    :raises InputError: no such file, or no ONNX
    """
    import onnx

    data = read_bytes(path, MAX_BYTES)
    model = onnx.ModelProto()
    try:
        model.ParseFromString(data)
    except Exception as error:  # protobuf's errors share no other base
        raise InputError(path, "is damaged or no ONNX file") from error
    if not model.HasField("graph"):
        raise InputError(path, "no graph, expected an ONNX model")
    return model


def problems(model: Any) -> Iterator[Problem]:
    """Everything that keeps a model from being run; later checks need the earlier ones to pass."""
    stages: tuple[tuple[tuple[str, Callable[[Any], Iterable[tuple[str, str]]]], ...], ...] = (
        (("OnnxText", _text),),
        (("OnnxVersion", _version), ("OnnxSelfContained", _self_contained), ("OnnxOperators", _operators)),
        (("OnnxFinite", _finite), ("OnnxChecker", _checker)),
        (("OnnxSize", _sizes), ("OnnxMetadata", metadata_faults)),
    )
    for stage in stages:
        of_stage = [
            Problem(name, _shown(where), _shown(message)) for name, check in stage for where, message in check(model)
        ]
        yield from of_stage
        if of_stage:
            return


def _text(model: Any) -> Iterator[tuple[str, str]]:
    """Protobuf gives names that are no UTF-8 as bytes."""
    graph = model.graph
    named = [*graph.node, *graph.initializer, *graph.input, *graph.output, *graph.value_info]
    texts = [one.name for one in (*named, *(one for node in graph.node for one in node.attribute))]
    texts += [text for node in graph.node for text in (node.op_type, node.domain, *node.input, *node.output)]
    texts += [text for prop in model.metadata_props for text in (prop.key, prop.value)]
    texts += [one.domain for one in model.opset_import]
    if not all(isinstance(text, str) for text in texts):
        yield "names", "not UTF-8"


def _version(model: Any) -> Iterator[tuple[str, str]]:
    if model.ir_version != IR_VERSION:
        yield "ir_version", f"is {model.ir_version}, expected {IR_VERSION}"
    opsets = [(one.domain, one.version) for one in model.opset_import]
    if opsets not in ([("", OPSET)], [("ai.onnx", OPSET)]):
        yield "opset_import", f"{opsets[:4]}, expected opset {OPSET} of the default domain alone"


def _self_contained(model: Any) -> Iterator[tuple[str, str]]:
    graph = model.graph
    for field, entries in (
        ("functions", model.functions),
        ("training_info", model.training_info),
        ("sparse_initializer", graph.sparse_initializer),
        ("quantization_annotation", graph.quantization_annotation),
    ):
        if len(entries):
            yield field, "present, expected none"
    for tensor in graph.initializer:
        if problem := _tensor_problem(tensor):
            yield f"tensor {tensor.name}", problem
    names = [tensor.name for tensor in graph.initializer]
    if len(set(names)) != len(names):
        yield "tensors", "several of one name"


def _tensor_problem(tensor: Any) -> str | None:
    if tensor.data_location or len(tensor.external_data):
        return "data outside of the file, expected it inside"
    if tensor.data_type not in TYPES:
        return f"of type {tensor.data_type}, expected float32, float16, int8 or int64"
    if any(size < 0 for size in tensor.dims) or len(tensor.dims) > 8:
        return f"shape {list(tensor.dims)[:9]}, expected at most 8 sizes of 0 or more"
    expected = math.prod(tensor.dims) * TYPES[tensor.data_type].itemsize
    if len(tensor.raw_data) != expected:
        return f"{len(tensor.raw_data)} bytes of raw data, expected {expected} for shape {list(tensor.dims)}"
    return None


def _operators(model: Any) -> Iterator[tuple[str, str]]:
    if len(model.graph.node) > _MAX_NODES:
        yield "graph", f"{len(model.graph.node)} nodes, expected at most {_MAX_NODES}"
        return
    for number, node in enumerate(model.graph.node):
        where = f"node {node.name or number}"
        if node.domain not in ("", "ai.onnx"):
            yield where, f"operator of domain '{node.domain}', expected the default domain"
        elif node.op_type not in PER_FRAME | FURTHER:
            yield where, f"operator {node.op_type}, expected one of {', '.join(sorted(PER_FRAME | FURTHER))}"
        for attribute in node.attribute:
            if attribute.type not in _PLAIN_ATTRIBUTES or attribute.ref_attr_name:
                yield f"{where} -> {attribute.name}", "attribute is no plain number or list of numbers"


def _finite(model: Any) -> Iterator[tuple[str, str]]:
    for tensor in model.graph.initializer:
        if not np.isfinite(np.frombuffer(tensor.raw_data, TYPES[tensor.data_type])).all():
            yield f"tensor {tensor.name}", "holds NaN or infinity, expected finite numbers"


def _checker(model: Any) -> Iterator[tuple[str, str]]:
    from onnx import checker, shape_inference

    try:
        checker.check_model(model, full_check=True)
    except (checker.ValidationError, shape_inference.InferenceError, ValueError, RuntimeError) as error:
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        yield "graph", (lines[0] if lines else type(error).__name__)


def _sizes(model: Any) -> Iterator[tuple[str, str]]:
    from onnx import shape_inference

    # without data_prop, which keeps each number of a shape as an object
    inferred = shape_inference.infer_shapes(model, strict_mode=True).graph
    values = {one.name: one for side in (inferred.input, inferred.output, inferred.value_info) for one in side}
    total = whole = 0
    for name in [one.name for one in model.graph.input] + [name for node in model.graph.node for name in node.output]:
        shape = shape_of(values[name]) if name in values else None
        if shape is None:
            yield f"value {name}", "its size is not fixed by the graph"
            return
        total += math.prod(shape)
        whole += math.prod(shape) * (values[name].type.tensor_type.elem_type == _INT64)
    most = FREE_ELEMENTS + PER_BYTE * sum(len(tensor.raw_data) for tensor in model.graph.initializer)
    if total > most:
        yield "graph", f"{total} numbers in an evaluation, expected at most {most}"
    if whole > _MAX_WHOLE:
        yield "graph", f"{whole} whole numbers in an evaluation, expected at most {_MAX_WHOLE}"


def _shown(text: str) -> str:
    """Text with names out of the file as one printable line."""
    return "".join(one if one.isprintable() else " " for one in text)[:300]


def validate(path: str | os.PathLike[str]) -> tuple[Finding, ...]:
    """What is wrong with a .onnx deformer and its sidecar.

    :raises InputError: no such file, or no ONNX at all
    """
    file = Path(path)
    model = read(file)
    faults = list(problems(model))
    if not faults:
        beside = sidecar_path(file)
        try:
            if file_beside(file, beside.name) is None:
                what = "no such file, expected the metadata beside the model"
                faults.append(Problem("OnnxSidecarMissing", beside.name, what))
            elif parse_json(read_bytes(beside, MAX_BYTES), beside.name) != model_metadata(model):
                faults.append(Problem("OnnxSidecar", beside.name, "differs from the metadata in the model"))
        except InputError as error:
            faults.append(Problem("OnnxSidecar", error.where, error.what))
    return tuple(
        Finding(
            check=f"facepipe:{problem.check}",
            severity="error" if problem.check != "OnnxSidecarMissing" else "warning",
            where=f"{file.name} -> {problem.where}",
            message=problem.message,
        )
        for problem in faults
    )
