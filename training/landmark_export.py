"""The landmark network as an ONNX file, written node by node: no paths of the machine, an opset that engines read."""

from __future__ import annotations

import json
from collections.abc import Mapping

import numpy as np
from landmark_network import COUNT, SIZE, LandmarkNetwork
from torch import nn

from facepipe.learn.networks.graph_writer import GraphWriter


def to_onnx(network: LandmarkNetwork, metadata: Mapping[str, object]) -> bytes:
    """The bytes of an ONNX model; `metadata` as ``facepipe.features``."""
    write = GraphWriter()
    stem = write.add("Relu", write.conv("stem", "image", network.stem, network.stem_norm))
    quarter = _stage(write, "quarter", stem, network.quarter)
    eighth = _stage(write, "eighth", quarter, network.eighth)
    deep = _stage(write, "sixteenth", eighth, network.sixteenth)
    sides = [write.conv(f"lateral{i}", at, network.laterals[i]) for i, at in enumerate((quarter, eighth, deep))]
    up = write.block("up_eighth", write.add("Add", _double(write, sides[2]), sides[1]), network.up_eighth)
    up = write.block("up_quarter", write.add("Add", _double(write, up), sides[0]), network.up_quarter)
    heat = write.conv("heat", up, network.heat)
    share = write.add("Softmax", write.reshape(heat, 0, COUNT, -1), axis=2)
    write.add("MatMul", share, write.constant("cells", network.cells), name="landmarks")
    pooled = write.add("Flatten", write.add("GlobalAveragePool", deep), axis=1)
    write.add("Sigmoid", write.linear("presence_logit", pooled, network.presence), name="presence")
    properties = {"facepipe.features": json.dumps(metadata, sort_keys=True)}
    ends = {"landmarks": (COUNT, 2), "presence": (1,)}
    return write.to_bytes("landmarks", {"image": (3, SIZE, SIZE)}, ends, properties)


def _stage(write: GraphWriter, name: str, source: str, blocks: nn.Sequential) -> str:
    for i, block in enumerate(blocks):
        source = write.block(f"{name}{i}", source, block)
    return source


def _double(write: GraphWriter, source: str) -> str:
    scales = write.constant("scales", np.array([1, 1, 2, 2]))
    modes = {"mode": "nearest", "coordinate_transformation_mode": "asymmetric", "nearest_mode": "floor"}
    return write.add("Resize", source, "", scales, **modes)
