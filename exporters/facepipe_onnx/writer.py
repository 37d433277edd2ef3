"""Writes the graph of a face or of an encoder, and its sidecar."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from facepipe.core import __version__
from facepipe.core.arrays import IntArray, require_finite
from facepipe.core.atomic import together, write_bytes
from facepipe.core.errors import ExportError, InputError, TopologyError
from facepipe.core.names import select
from facepipe.core.reports import ExportReport
from facepipe.geometry.polygons import point_triangles
from facepipe.onnx_graph import MAX_BYTES, Nodes
from facepipe.parts import FaceParts, HasParts, Slider
from facepipe.rig import Rig, set_face
from facepipe.rig import build as build_rig
from facepipe.rig.animation import linear_skinning_notes
from facepipe.rig.neural_rig import EPSILON, EncoderLayer, NeuralEncoder
from facepipe.rig.sliders import modes_line
from facepipe_onnx import slider_graph
from facepipe_onnx.describe import describe
from facepipe_onnx.graph import build, select_shapes
from facepipe_onnx.metadata import ENCODER, FURTHER, PREFIX, operators, sidecar_path
from facepipe_onnx.options import Options
from facepipe_onnx.packed_weights import packed_error
from facepipe_onnx.read import problems

_CONVENTIONS = {
    "points": "points of all meshes one after another, in their order on the face; only those that `chosen` numbers "
    "count, the others may be anything",
    "lengths": "millimetres",
    "space": "world space at bind time, right-handed, up axis face.up_axis; the head as it is at rest, not turned",
    "controls": "clamped to their ranges",
}


def outputs(path: str | os.PathLike[str]) -> tuple[Path, Path]:
    """The files that `export` to `path` writes: the model and its sidecar.

    :raises InputError: another suffix than .onnx
    """
    target = Path(path)
    if target.suffix.lower() != ".onnx":
        raise InputError(target, f"suffix '{target.suffix}', expected .onnx")
    return target, sidecar_path(target)


def write_model(model: Any, metadata: dict[str, Any], name: str, path: str | os.PathLike[str]) -> int:
    """Write a model with its metadata, and that beside it, both or neither; the bytes of the model.

    :raises ExportError: more than a file holds, or anything that `problems` finds
    """
    target, beside = outputs(path)
    model.producer_version = __version__
    for key in sorted(metadata):
        entry = model.metadata_props.add()
        entry.key, entry.value = PREFIX + key, json.dumps(metadata[key], sort_keys=True, allow_nan=False)
    if model.ByteSize() > MAX_BYTES:
        raise ExportError(name, f"{model.ByteSize()} bytes, expected at most {MAX_BYTES}: what an ONNX file holds")
    for problem in problems(model):
        raise ExportError(f"{name} -> {problem.where}", problem.message)
    data = bytes(model.SerializeToString(deterministic=True))
    with together(target):
        write_bytes(target, data)
        write_bytes(beside, f"{json.dumps(metadata, sort_keys=True, indent=1, allow_nan=False)}\n".encode())
    return len(data)


def _affine(nodes: Nodes, value: str, name: str, matrix: Any, bias: Any) -> str:
    product = nodes.add("MatMul", value, nodes.constant(name, matrix))
    return nodes.add("Add", product, nodes.constant(f"{name}_bias", bias))


def _norm(nodes: Nodes, tokens: str, mean: str, epsilon: str) -> str:
    """Tokens less their mean, over the root of their variance."""
    centred = nodes.add("Sub", tokens, nodes.add("MatMul", tokens, mean))
    variance = nodes.add("MatMul", nodes.add("Mul", centred, centred), mean)
    return nodes.add("Div", centred, nodes.add("Sqrt", nodes.add("Add", variance, epsilon)))


def _attention(nodes: Nodes, tokens: str, layer: EncoderLayer, heads: int) -> str:
    """[k, d] of tokens [k, d]."""
    width = len(layer.join)
    head_width = width // heads
    matrix, bias = np.array(layer.attend, np.float64), np.array(layer.attend_bias, np.float64)
    matrix[:, :width] /= np.sqrt(head_width)  # what scores are divided by
    bias[:width] /= np.sqrt(head_width)
    attended = _affine(nodes, tokens, "attend", matrix, bias)
    pieces = [
        nodes.reshape(nodes.slice(attended, 1, i * width, (i + 1) * width), -1, heads, head_width) for i in range(3)
    ]
    queries, values = (nodes.add("Transpose", pieces[i], perm=[1, 0, 2]) for i in (0, 2))
    keys = nodes.add("Transpose", pieces[1], perm=[1, 2, 0])
    shares = nodes.add("Softmax", nodes.add("MatMul", queries, keys), axis=-1)
    joined = nodes.add("Transpose", nodes.add("MatMul", shares, values), perm=[1, 0, 2])
    return _affine(nodes, nodes.reshape(joined, -1, width), "join", layer.join, layer.join_bias)


def _in_own_units(nodes: Nodes, encoder: NeuralEncoder, value: str) -> None:
    """`controls` of values that are clamped to -1..1."""
    low, high = (np.array([getattr(control, key) for control in encoder.controls]) for key in ("minimum", "maximum"))
    ends = [nodes.constant(name, np.array(end)) for name, end in (("lowest", -1.0), ("highest", 1.0))]
    clamped = nodes.add("Clip", value, *ends)
    scaled = nodes.add("Mul", clamped, nodes.constant("half_range", (high - low) / 2.0))
    nodes.add("Add", scaled, nodes.constant("middle", (high + low) / 2.0), name="controls")


def _describe(encoder: NeuralEncoder, operators: list[str], meshes: Mapping[str, int], name: str) -> dict[str, Any]:
    """The metadata of the graph; `operators` are sorted, `meshes` (name -> points) in the order of the face."""
    controls, first, outputs = encoder.controls, 0, []
    for mesh, count in meshes.items():
        outputs.append({"name": mesh, "first": first, "count": count})
        first += count
    return {
        "conventions": _CONVENTIONS,
        "face": {"meters_per_unit": 0.001, "name": name, "topology": encoder.topology, "up_axis": "Y"},
        "format": ENCODER.format,
        "further_operators": [operator for operator in operators if operator in FURTHER],
        "generator": f"facepipe {__version__}",
        "inputs": [
            {
                "chosen": encoder.chosen.tolist(),
                "name": "points",
                "required": True,
                "shape": [1, encoder.point_count, 3],
                "type": "float32",
            }
        ],
        "meshes": outputs,
        "operators": operators,
        "outputs": [
            {
                "default": [control.default for control in controls],
                "name": "controls",
                "names": [control.name for control in controls],
                "range": [[control.minimum, control.maximum] for control in controls],
                "shape": [1, len(controls)],
                "type": "float32",
            }
        ],
    }


def export_encoder(
    encoder: NeuralEncoder, path: str | os.PathLike[str], meshes: Mapping[str, int] | None = None, name: str = "face"
) -> ExportReport:
    """Write an encoder as an ONNX graph, points to controls, with its metadata also beside it as ``<path>.json``.

    :param meshes: name -> points of the face's meshes, in their order, for the metadata
    :param name: of the face
    :raises InputError: another suffix than .onnx, or a folder that does not exist
    :raises TopologyError: meshes of another number of points
    :raises ExportError: numbers beyond float32
    """
    start = time.perf_counter()
    target, beside = outputs(path)
    meshes = {name: encoder.point_count} if meshes is None else meshes
    if sum(meshes.values()) != encoder.point_count:
        what = f"{sum(meshes.values())} points, expected {encoder.point_count} that the encoder was learned on"
        raise TopologyError(f"{name} -> meshes", what)
    # the `onnx.ModelProto`, without metadata: ``points`` [1, n, 3] to ``controls`` [1, c], clamped to their limits
    nodes = Nodes()
    count, tokens = len(encoder.chosen), len(encoder.places)
    chosen = nodes.gather("points", 1, encoder.chosen)
    offsets = nodes.add("Sub", chosen, nodes.constant("rest", encoder.rest))
    # tanh((x / s) W + b) = tanh(x (W / s) + b): the scale costs no operator
    hidden = _affine(nodes, offsets, "point", encoder.point / encoder.scale, encoder.point_bias)
    features = _affine(nodes, nodes.add("Tanh", hidden), "feature", encoder.feature, encoder.feature_bias)
    rows = nodes.reshape(features, tokens, len(encoder.token))
    value = _affine(nodes, rows, "token", encoder.token, encoder.places)
    width = encoder.token.shape[1]
    norm = (nodes.constant("mean", np.full((width, 1), 1.0 / width)), nodes.constant("epsilon", np.array(EPSILON)))
    for layer in encoder.layers:
        value = nodes.add("Add", value, _attention(nodes, _norm(nodes, value, *norm), layer, encoder.heads))
        wide = nodes.add("Relu", _affine(nodes, _norm(nodes, value, *norm), "widen", layer.widen, layer.widen_bias))
        value = nodes.add("Add", value, _affine(nodes, wide, "narrow", layer.narrow, layer.narrow_bias))
    flat = nodes.reshape(value, 1, len(encoder.reduce))
    reduced = nodes.add("Tanh", _affine(nodes, flat, "reduce", encoder.reduce, encoder.reduce_bias))
    bent = nodes.add("MatMul", reduced, nodes.constant("last", encoder.last))
    straight = _affine(nodes, nodes.reshape(offsets, 1, 3 * count), "straight", encoder.straight, encoder.offset)
    _in_own_units(nodes, encoder, nodes.add("Add", bent, straight))
    inputs = {"points": (1, encoder.point_count, 3)}
    model = nodes.model("facepipe_encoder", name, inputs, {"controls": (1, len(encoder.controls))})
    metadata = _describe(encoder, operators(model), meshes, name)
    size = write_model(model, metadata, name, target)
    return ExportReport(
        path=target,
        files=(target, beside),
        counts={
            "points": encoder.point_count,
            "chosen": len(encoder.chosen),
            "controls": len(encoder.controls),
            "nodes": len(model.graph.node),
        },
        bytes=size,
        seconds=time.perf_counter() - start,
    )


def export(face: HasParts, path: str | os.PathLike[str], options: Options | None = None) -> ExportReport:
    """Write a face as an ONNX deformer, with its metadata also beside it as ``<path>.json``.

    :raises ExportError: nothing that deforms, NaN or infinity, numbers beyond float32, or more than 2 GB
    :raises InputError: another suffix than .onnx, a folder that does not exist, or a bad option
    """
    if options is not None and options.encoder:
        encoder, parts = getattr(face, "encoder", None), face.parts()
        if encoder is None:
            raise InputError("option encoder", "without one, expected --neural with a rig that has an encoder")
        return export_encoder(encoder, path, {mesh.name: len(mesh.points) for mesh in parts.meshes}, parts.name)
    return export_parts(face.parts(), path, options)


def export_parts(parts: FaceParts, path: str | os.PathLike[str], options: Options | None = None) -> ExportReport:
    """`export` of a face given as arrays.

    :raises TopologyError: indices and counts that don't fit, or a singular bind transform
    """
    start = time.perf_counter()
    (target, beside), options = outputs(path), options or Options()
    require_finite(parts, parts.name, error=ExportError)
    delivered = set_face(parts, options.pose)
    parts, no_modes = delivered.parts, modes_line(delivered.parts.sliders) if options.sliders else ()
    parts = replace(parts, sliders=tuple(slider for slider in parts.sliders if not slider.modes))
    whole = replace(build_rig(parts), dual=None)  # graphs blend joints linearly, which the report says
    triangles = _triangles(parts, whole) if options.normals else None
    names = select(whole.shapes, options.shapes, "shapes")
    rig, sliders, network = select_shapes(whole, names), None, None
    if options.sliders:
        model = slider_graph.build(whole, parts.sliders, options, network=parts.slider_network, triangles=triangles)
        sliders, network = slider_graph.select_driven(whole, parts.sliders, parts.slider_network, names)
    else:
        model = build(whole, options, triangles=triangles)
    metadata = describe(parts, rig, options, operators(model), sliders, network)
    packed = None
    if options.weights != "float32":
        plain = replace(options, weights="float32", points=False, normals=False)
        exact = slider_graph.build(whole, parts.sliders, plain, network=parts.slider_network)
        packed = packed_error(model, exact, rig, parts.sliders, 1e3 * parts.meters_per_unit)
        metadata["packed_weights"] = {"type": options.weights, **packed}
    size = write_model(model, metadata, parts.name, target)
    counts = {} if sliders is None else {"sliders": len(sliders)}
    if sliders is None or options.points:
        counts["points"] = len(rig.points)
    return ExportReport(
        path=target,
        files=(target, beside),
        counts=(
            counts
            | {
                "shapes": len(rig.shapes),
                "sculpts": len(rig.targets),
                "joints": len(rig.joints),
                "nodes": len(model.graph.node),
            }
        ),
        bytes=size,
        seconds=time.perf_counter() - start,
        warnings=linear_skinning_notes(parts),
        dropped=(*_dropped(parts, options, sliders), *no_modes),
        error_mm=None if packed is None else packed["error_mm"],
        pose=delivered.pose,
        pose_error=None if delivered.error is None else asdict(delivered.error),
    )


def _triangles(parts: FaceParts, rig: Rig) -> IntArray:
    """(t, 3) triangles of all meshes."""
    return np.concatenate(
        [
            point_triangles(mesh.face_vertex_counts, mesh.face_vertex_indices).reshape(-1, 3) + start
            for mesh, start in zip(parts.meshes, rig.mesh_offsets[:-1], strict=True)
        ]
        or [np.zeros((0, 3), dtype=np.int64)]
    )


def _dropped(parts: FaceParts, options: Options, sliders: Sequence[Slider] | None) -> tuple[str, ...]:
    """Lines on what the graph leaves out."""
    sculpted = {shape.name for mesh in parts.meshes for shape in mesh.blendshapes if shape.normal_offsets is not None}
    driven = sum(len(slider.shapes) for slider in parts.sliders) if options.sliders else 0
    beside = parts.slider_network is not None and not options.sliders
    counts = (
        (driven - sum(len(one.shapes) for one in sliders or ()), "shapes of sliders"),
        (int(beside), "learned network of the sliders"),
        (len(parts.meshes) if options.sliders and not options.points else 0, "meshes"),
        (len(parts.animations), "animations"),
        (len(parts.materials), "materials"),
        (len(parts.variants), "variants of materials"),
        (sum(len(mesh.uv_sets) for mesh in parts.meshes), "UV sets"),
        (sum(mesh.normals is not None for mesh in parts.meshes), "meshes with authored normals"),
        (len(sculpted), "blendshapes with normal offsets"),
        (sum(mesh.colors is not None for mesh in parts.meshes), "meshes with display colours"),
        (len({name for mesh in parts.meshes for name in (*mesh.regions, *mesh.point_subsets)}), "regions"),
        (len({scheme for mesh in parts.meshes for scheme in mesh.landmarks}), "landmark schemes"),
    )
    return tuple(f"{what}: {count}" for count, what in counts if count)
