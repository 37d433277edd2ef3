"""Whether the metadata of a model is that of a facepipe graph, and tells what the graph takes and gives."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from facepipe.core.errors import InputError
from facepipe_onnx import sidecar
from facepipe_onnx.kinds import KINDS, Kind
from facepipe_onnx.operators import FURTHER

TYPES: dict[int, np.dtype[Any]] = {  # TensorProto.FLOAT, INT8, INT64, FLOAT16
    1: np.dtype("<f4"),
    3: np.dtype("<i1"),
    7: np.dtype("<i8"),
    10: np.dtype("<f2"),
}

_REQUIRED = ("conventions", "face", "format", "inputs", "meshes", "operators", "outputs")


def properties(model: Any) -> dict[str, str]:
    """The model's metadata_props."""
    return {one.key: one.value for one in model.metadata_props}


def operators(model: Any) -> list[str]:
    """The operators of a graph, sorted."""
    return sorted({node.op_type for node in model.graph.node})


def metadata_faults(model: Any) -> Iterator[tuple[str, str]]:
    """What is wrong with the metadata of a model: where, and what."""
    try:
        metadata = sidecar.from_properties(properties(model))
    except InputError as error:
        yield error.where, error.what
        return
    missing = [key for key in _REQUIRED if key not in metadata]
    if missing:
        yield "metadata", f"no {sidecar.PREFIX}{missing[0]}, expected the metadata of a facepipe graph"
        return
    kind = next((one for one in KINDS if one.format == metadata["format"]), None)
    if kind is None:
        expected = " or ".join(str(one.format) for one in KINDS)
        yield f"metadata {sidecar.PREFIX}format", f"is {str(metadata['format'])[:80]}, expected {expected}"
        return
    joints = metadata.get("joints", [])
    if not isinstance(joints, list) or not all(
        isinstance(one, dict) and isinstance(one.get("path"), str) for one in joints
    ):
        yield f"metadata {sidecar.PREFIX}joints", "expected a list of objects, each with its path"
    for side, values in (("inputs", model.graph.input), ("outputs", model.graph.output)):
        yield from _described(metadata[side], {one.name: shape_of(one) for one in values}, side, kind)
    if metadata["operators"] != operators(model):
        yield f"metadata {sidecar.PREFIX}operators", "not the operators of the graph"
    further = [name for name in operators(model) if name in FURTHER]
    if metadata.get("further_operators", []) != further:
        yield f"metadata {sidecar.PREFIX}further_operators", f"expected {further}"


def _described(
    described: Any, values: dict[str, tuple[int, ...] | None], side: str, kind: Kind
) -> Iterator[tuple[str, str]]:
    """Whether the inputs or outputs that the metadata describes are those of the graph."""
    where = f"metadata {sidecar.PREFIX}{side}"
    if not isinstance(described, list) or not all(isinstance(one, dict) for one in described):
        yield where, "expected a list of objects"
        return
    known = kind.inputs if side == "inputs" else kind.outputs
    if not set(values) <= known or not any(known & needed <= set(values) for needed in kind.needed):
        yield side, f"{', '.join(sorted(values))[:100]}: expected some of {', '.join(sorted(known))}"
        return
    shapes = {str(one.get("name")): one.get("shape") for one in described}
    if len(shapes) != len(described) or shapes != {name: list(shape or ()) for name, shape in values.items()}:
        yield where, f"names and shapes are not those of the graph's {side}"
        return
    for one in described:
        for key in ("names", "joints"):
            names = one.get(key)
            if names is not None and not _is_names(names, one["shape"]):
                yield f"{where} -> {one['name']} -> {key}", f"expected distinct names, one for each of {one['shape']}"


def _is_names(names: Any, shape: list[int]) -> bool:
    texts = isinstance(names, list) and all(isinstance(name, str) for name in names)
    return texts and len(set(names)) == len(names) and len(shape) > 1 and len(names) == shape[1]


def shape_of(value: Any) -> tuple[int, ...] | None:
    """The shape of an input or output; None where the graph leaves it open, or its type is another."""
    tensor = value.type.tensor_type
    if tensor.elem_type not in TYPES or not tensor.HasField("shape"):
        return None
    if any(not size.HasField("dim_value") or size.dim_value < 0 for size in tensor.shape.dim):
        return None
    return tuple(size.dim_value for size in tensor.shape.dim)
