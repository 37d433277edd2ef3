"""The networks of landmarks and masks as ONNX files, written node by node: no paths, an opset that engines read."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping

import numpy as np
from landmark_network import COUNT, SIZE, DenseNetwork, LandmarkNetwork, MaskNetwork, Pyramid
from torch import nn

from facepipe.rig.torch.graph_writer import GraphWriter


def to_onnx(network: LandmarkNetwork, metadata: Mapping[str, object]) -> bytes:
    """The bytes of an ONNX model; `metadata` as ``facepipe.features``."""
    write = GraphWriter()
    up, deep = _pyramid(write, network)
    heat = write.conv("heat", up, network.heat)
    share = write.add("Softmax", write.reshape(heat, 0, COUNT, -1), axis=2)
    write.add("MatMul", share, write.constant("cells", network.cells), name="landmarks")
    pooled = write.add("Flatten", write.add("GlobalAveragePool", deep), axis=1)
    write.add("Sigmoid", write.linear("presence_logit", pooled, network.presence), name="presence")
    ends = {"landmarks": (COUNT, 2), "presence": (1,)}
    return write.to_bytes("landmarks", {"image": (3, SIZE, SIZE)}, ends, _properties(metadata))


def dense_onnx(network: DenseNetwork, metadata: Mapping[str, object]) -> bytes:
    """The same of many landmarks, and of the mean errors to expect of them in 0..1 of the crop."""
    write, count = GraphWriter(), len(network.usual)
    up, _ = _pyramid(write, network)
    channels = network.heat.in_channels
    share = write.add("Softmax", write.reshape(write.conv("heat", up, network.heat), 0, count, -1), axis=2)
    write.add("MatMul", share, write.constant("cells", network.cells), name="landmarks")
    across = write.add("Transpose", write.reshape(up, 0, channels, -1), perm=[0, 2, 1])
    weight = write.constant("doubt_weight", network.doubt.weight.detach().T)
    doubt = write.reshape(write.add("MatMul", write.add("MatMul", share, across), weight), 0, count)
    usual = write.constant("usual", (network.usual + network.doubt.bias).detach() + math.log(2 / network.SIZE))
    write.add("Exp", write.add("Add", doubt, usual), name="errors")
    size, ends = network.SIZE, {"landmarks": (count, 2), "errors": (count,)}
    return write.to_bytes("dense_landmarks", {"image": (3, size, size)}, ends, _properties(metadata))


def mask_onnx(network: MaskNetwork, metadata: Mapping[str, object]) -> bytes:
    """The same of what a picture shows: shares of each class."""
    write = GraphWriter()
    up, _ = _pyramid(write, network)
    write.add("Softmax", write.conv("classes", up, network.classes), name="shares", axis=1)
    size, ends = network.SIZE, {"shares": (len(network.CLASSES), network.CELLS, network.CELLS)}
    return write.to_bytes("face_mask", {"image": (3, size, size)}, ends, _properties(metadata))


def _properties(metadata: Mapping[str, object]) -> dict[str, str]:
    return {"facepipe.features": json.dumps(metadata, sort_keys=True)}


def _pyramid(write: GraphWriter, network: Pyramid) -> tuple[str, str]:
    """What `Pyramid.pyramid` gives."""
    at = write.add("Relu", write.conv("stem", "image", network.stem, network.stem_norm))
    levels = [at] if network.finest else []
    for i, stage in enumerate(network.stages):
        at = _stage(write, f"stage{i}", at, stage)
        levels.append(at)
    sides = [write.conv(f"lateral{i}", level, network.laterals[i]) for i, level in enumerate(levels)]
    up = sides[-1]
    for i, (side, block) in enumerate(zip(sides[-2::-1], network.ups, strict=True)):
        up = write.block(f"up{i}", write.add("Add", _double(write, up), side), block)
    return up, at


def _stage(write: GraphWriter, name: str, source: str, blocks: nn.Sequential) -> str:
    for i, block in enumerate(blocks):
        source = write.block(f"{name}{i}", source, block)
    return source


def _double(write: GraphWriter, source: str) -> str:
    scales = write.constant("scales", np.array([1, 1, 2, 2]))
    modes = {"mode": "nearest", "coordinate_transformation_mode": "asymmetric", "nearest_mode": "floor"}
    return write.add("Resize", source, "", scales, **modes)
