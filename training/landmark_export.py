"""The landmark network as an ONNX file, written node by node: no paths of the machine, an opset that engines read."""

from __future__ import annotations

import json
from collections.abc import Mapping

from torch import nn

from facepipe.learn.networks.graph_writer import GraphWriter
from facepipe.learn.networks.landmark_network import COUNT, SIZE, LandmarkNetwork


def to_onnx(network: LandmarkNetwork, metadata: Mapping[str, object]) -> bytes:
    """The bytes of an ONNX model; `metadata` as ``facepipe.features``."""
    write = GraphWriter()
    stem = write.relu("stem", write.conv("stem", "image", network.stem, network.stem_norm))
    quarter = _stage(write, "quarter", stem, network.quarter)
    eighth = _stage(write, "eighth", quarter, network.eighth)
    deep = _stage(write, "sixteenth", eighth, network.sixteenth)
    sides = [write.conv(f"lateral{i}", at, network.laterals[i]) for i, at in enumerate((quarter, eighth, deep))]
    up = write.add("Add", "up_eighth_in", _double(write, "double_deep", sides[2]), sides[1])
    up = write.block("up_eighth", up, network.up_eighth)
    up = write.add("Add", "up_quarter_in", _double(write, "double_eighth", up), sides[0])
    heat = write.conv("heat", write.block("up_quarter", up, network.up_quarter), network.heat)
    shape = write.shape("heat_shape", [0, COUNT, -1])
    share = write.add("Softmax", "share", write.add("Reshape", "heat_rows", heat, shape), axis=2)
    write.add("MatMul", "landmarks", share, write.constant("cells", network.cells))
    pooled = write.add("Flatten", "pooled_row", write.add("GlobalAveragePool", "pooled", deep), axis=1)
    write.add("Sigmoid", "presence", write.linear("presence_logit", pooled, network.presence))
    properties = {"facepipe.features": json.dumps(metadata, sort_keys=True)}
    return write.model("landmarks", {"image": (3, SIZE, SIZE)}, {"landmarks": (COUNT, 2), "presence": (1,)}, properties)


def _stage(write: GraphWriter, name: str, source: str, blocks: nn.Sequential) -> str:
    for i, block in enumerate(blocks):
        source = write.block(f"{name}{i}", source, block)
    return source


def _double(write: GraphWriter, name: str, source: str) -> str:
    scales = write.constant(f"{name}_scales", [1, 1, 2, 2])
    modes = {"mode": "nearest", "coordinate_transformation_mode": "asymmetric", "nearest_mode": "floor"}
    return write.add("Resize", name, source, "", scales, **modes)
