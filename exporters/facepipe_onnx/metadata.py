"""The metadata of a graph: the kinds of graphs and their operators, JSON in the model and beside it, and its checks.

Top-level keys are stored as `metadata_props` ``facepipe.<key>``; the sidecar ``<model file>.json`` is an object of
them.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from facepipe.core.errors import InputError

PREFIX = "facepipe."
PER_FRAME = frozenset(
    {"Clip", "Gemm", "MatMul", "Add", "Sub", "Mul", "Relu", "Tanh", "Sigmoid", "Sin", "Cos"}
    | {"Concat", "Slice", "Reshape", "Transpose", "Gather"}
)
# Of compressed weights, normals and encoders; declared in the sidecar where a graph uses them.
FURTHER = frozenset({"Cast", "Div", "Softmax", "Sqrt"})
TYPES: dict[int, np.dtype[Any]] = {  # TensorProto.FLOAT, INT8, INT16, INT64, FLOAT16
    1: np.dtype("<f4"),
    3: np.dtype("<i1"),
    5: np.dtype("<i2"),
    7: np.dtype("<i8"),
    10: np.dtype("<f2"),
}
_REQUIRED = ("conventions", "face", "format", "inputs", "meshes", "operators", "outputs")


def sidecar_path(model: Path) -> Path:
    """The sidecar of a model file."""
    return model.with_name(f"{model.name}.json")


def model_metadata(model: Any) -> dict[str, Any]:
    """The metadata in a model; keys of others are left out.

    :raises InputError: text that is no JSON
    """
    ours = {prop.key.removeprefix(PREFIX): prop.value for prop in model.metadata_props if prop.key.startswith(PREFIX)}
    return {key: parse_json(text, f"metadata {PREFIX}{key}") for key, text in ours.items()}


def parse_json(text: str | bytes, where: object) -> Any:
    """JSON without NaN and infinity.

    :raises InputError: it is not that
    """

    def refuse(word: str) -> Any:
        raise ValueError(f"number {word}")

    try:
        return json.loads(text, parse_constant=refuse)
    except (ValueError, RecursionError) as error:
        raise InputError(where, f"no valid JSON ({error})") from error


class Kind(NamedTuple):
    """One kind of graph."""

    name: str
    inputs: frozenset[str]
    outputs: frozenset[str]
    needed: tuple[frozenset[str], ...]  # inputs and outputs of which one of these sets is always there

    @property
    def format(self) -> dict[str, object]:
        """The metadata's ``format``."""
        return {"name": self.name, "version": 1}


DEFORMER = Kind(
    "facepipe deformer",
    frozenset({"weights", "coefficients", "joint_transforms", "parent"}),
    frozenset({"points", "joint_matrices", "normals"}),
    (frozenset({"points"}),),
)
SLIDERS = Kind(
    "facepipe sliders",
    frozenset({"sliders", "weights", "parent"}),
    frozenset({"coefficients", "skinning_matrices", "morph_weights", "points", "normals"}),
    (frozenset({"sliders", "coefficients", "skinning_matrices"}), frozenset({"sliders", "morph_weights"})),
)
ENCODER = Kind(
    "facepipe encoder",
    frozenset({"points"}),
    frozenset({"controls"}),
    (frozenset({"points", "controls"}),),
)
PERSONS = Kind(
    "facepipe persons",
    frozenset({"modes", "identity_joints", "placement", "parts", "offsets"}),
    frozenset({"points", "joints"}),
    (frozenset({"offsets", "points"}),),
)
KINDS = (DEFORMER, SLIDERS, ENCODER, PERSONS)


def operators(model: Any) -> list[str]:
    """The operators of a graph, sorted."""
    return sorted({node.op_type for node in model.graph.node})


def metadata_faults(model: Any) -> Iterator[tuple[str, str]]:
    """Errors of a model's metadata: place and message."""
    try:
        metadata = model_metadata(model)
    except InputError as error:
        yield error.where, error.what
        return
    missing = [key for key in _REQUIRED if key not in metadata]
    if missing:
        yield "metadata", f"no {PREFIX}{missing[0]}, expected the metadata of a facepipe graph"
        return
    kind = next((one for one in KINDS if one.format == metadata["format"]), None)
    if kind is None:
        expected = " or ".join(str(one.format) for one in KINDS)
        yield f"metadata {PREFIX}format", f"is {str(metadata['format'])[:80]}, expected {expected}"
        return
    joints = metadata.get("joints", [])
    if not isinstance(joints, list) or not all(
        isinstance(joint, dict) and isinstance(joint.get("path"), str) for joint in joints
    ):
        yield f"metadata {PREFIX}joints", "expected a list of objects, each with its path"
    for side, values in (("inputs", model.graph.input), ("outputs", model.graph.output)):
        yield from _described(metadata[side], {one.name: shape_of(one) for one in values}, side, kind)
    if metadata["operators"] != operators(model):
        yield f"metadata {PREFIX}operators", "not the operators of the graph"
    further = [name for name in operators(model) if name in FURTHER]
    if metadata.get("further_operators", []) != further:
        yield f"metadata {PREFIX}further_operators", f"expected {further}"


def _described(
    described: Any, values: dict[str, tuple[int, ...] | None], side: str, kind: Kind
) -> Iterator[tuple[str, str]]:
    """Whether the inputs or outputs that the metadata describes are those of the graph."""
    where = f"metadata {PREFIX}{side}"
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
    for value in described:
        for key in ("names", "joints"):
            names, shape = value.get(key), value["shape"]
            texts = isinstance(names, list) and all(isinstance(name, str) for name in names)
            fits = texts and len(set(names)) == len(names) and len(shape) > 1 and len(names) == shape[1]
            if names is not None and not fits:
                yield f"{where} -> {value['name']} -> {key}", f"expected distinct names, one for each of {shape}"


def shape_of(value: Any) -> tuple[int, ...] | None:
    """The shape of an input or output; None where the graph leaves it open, or its type is another."""
    tensor = value.type.tensor_type
    if tensor.elem_type not in TYPES or not tensor.HasField("shape"):
        return None
    if any(not size.HasField("dim_value") or size.dim_value < 0 for size in tensor.shape.dim):
        return None
    return tuple(size.dim_value for size in tensor.shape.dim)
