"""The graph of an encoder, points to controls, with its metadata also in a sidecar."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from facepipe.core import __version__
from facepipe.core.errors import TopologyError
from facepipe.core.reports import ExportReport
from facepipe.onnx_graph import Nodes
from facepipe.rig.neural_encoder import EPSILON, EncoderLayer, NeuralEncoder
from facepipe_onnx.metadata import ENCODER, FURTHER, operators
from facepipe_onnx.model_file import outputs, write_model

_CONVENTIONS = {
    "points": "points of all meshes one after another, in their order on the face; only those that `chosen` numbers "
    "count, the others may be anything",
    "lengths": "millimetres",
    "space": "world space at bind time, right-handed, up axis face.up_axis; the head as it is at rest, not turned",
    "controls": "clamped to their ranges",
}


def _build(encoder: NeuralEncoder, name: str = "face") -> Any:
    """The `onnx.ModelProto`, without metadata: ``points`` [1, n, 3] to ``controls`` [1, c], clamped to their limits.

    :param name: of the face, for messages
    :raises ExportError: numbers beyond float32
    """
    nodes = Nodes()
    count, tokens = len(encoder.chosen), len(encoder.places)
    chosen = nodes.gather("points", 1, encoder.chosen)
    offsets = nodes.add("Sub", chosen, nodes.constant("rest", encoder.rest))
    # tanh((x / s) W + b) = tanh(x (W / s) + b): the scale costs no operator
    hidden = _affine(nodes, offsets, "point", encoder.point / encoder.scale, encoder.point_bias)
    features = _affine(nodes, nodes.add("Tanh", hidden), "feature", encoder.feature, encoder.feature_bias)
    rows = nodes.reshape(features, tokens, len(encoder.token))
    value = _affine(nodes, rows, "token", encoder.token, encoder.places)
    norm = _Norm(nodes, encoder.token.shape[1])
    for layer in encoder.layers:
        value = nodes.add("Add", value, _attention(nodes, norm(value), layer, encoder.heads))
        wide = nodes.add("Relu", _affine(nodes, norm(value), "widen", layer.widen, layer.widen_bias))
        value = nodes.add("Add", value, _affine(nodes, wide, "narrow", layer.narrow, layer.narrow_bias))
    flat = nodes.reshape(value, 1, len(encoder.reduce))
    reduced = nodes.add("Tanh", _affine(nodes, flat, "reduce", encoder.reduce, encoder.reduce_bias))
    bent = nodes.add("MatMul", reduced, nodes.constant("last", encoder.last))
    straight = _affine(nodes, nodes.reshape(offsets, 1, 3 * count), "straight", encoder.straight, encoder.offset)
    _in_own_units(nodes, encoder, nodes.add("Add", bent, straight))
    inputs = {"points": (1, encoder.point_count, 3)}
    return nodes.model("facepipe_encoder", name, inputs, {"controls": (1, len(encoder.controls))})


def _affine(nodes: Nodes, value: str, name: str, matrix: Any, bias: Any) -> str:
    product = nodes.add("MatMul", value, nodes.constant(name, matrix))
    return nodes.add("Add", product, nodes.constant(f"{name}_bias", bias))


class _Norm:
    """Adds the nodes of tokens less their mean, over the root of their variance."""

    def __init__(self, nodes: Nodes, width: int) -> None:
        self._nodes = nodes
        self._mean = nodes.constant("mean", np.full((width, 1), 1.0 / width))
        self._epsilon = nodes.constant("epsilon", np.array(EPSILON))

    def __call__(self, tokens: str) -> str:
        add = self._nodes.add
        centred = add("Sub", tokens, add("MatMul", tokens, self._mean))
        variance = add("MatMul", add("Mul", centred, centred), self._mean)
        return add("Div", centred, add("Sqrt", add("Add", variance, self._epsilon)))


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


def _describe(
    encoder: NeuralEncoder, operators: list[str], meshes: Mapping[str, int], name: str = "face"
) -> dict[str, Any]:
    """The metadata of the graph of `_build`.

    :param operators: the operators of the graph, sorted
    :param meshes: name -> points, in the order of the face
    """
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
    model = _build(encoder, name)
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
