"""The residual network that guesses sliders, expression and pose from an aligned crop ([0184]), and its ONNX graph.

He et al., "Deep Residual Learning for Image Recognition", CVPR 2016 (blocks). The places of the landmarks, by which the
crop was made, come in beside the picture.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from facepipe.geometry.face_crops import TEMPLATE
from facepipe.photo.descent.subject import NUMBERS, Subject
from facepipe.rig.torch.graph_writer import Block, GraphWriter
from facepipe.rig.torch.one_thread import short_floats

SIZE = 128  # pixels a side of the crop
COUNT = 68
MEAN, STD = 0.45, 0.25  # of sRGB 0..1
POSE_MEAN = (0.0, 0.0, 0.0, 0.5, 0.485, 0.29, 0.85)  # relative to the crop
POSE_STD = (0.2, 0.35, 0.05, 0.01, 0.01, 0.03, 0.35)
SPREAD = 0.03  # of landmarks around the template, in sides of the crop
WIDTHS = (16, 32, 64, 96)  # at 1/2, 1/4, 1/8 and 1/16 of the resolution
CELLS = SIZE // 16
SQUEEZED, HIDDEN = 16, 256
KEY = "facepipe.photo"
KIND = "photo-start"
FURTHER_OPERATORS = ("Conv",)  # beside those that every engine has for per-frame graphs


class Output(NamedTuple):
    """Guesses of b crops, before sliders and expressions are cut to 0..1."""

    shares: Tensor  # (b, f) of the free sliders' ranges
    expressions: Tensor  # (b, e)
    pose: Tensor  # (b, 7) as `CropSpace`, in standard deviations from the mean


class StartNetwork(nn.Module):  # type: ignore[misc]
    """Crops (b, 3, 128, 128), sRGB less `MEAN` over `STD`, and landmarks (b, 68, 2) in sides of the crop to guesses."""

    def __init__(self, default_shares: Tensor, expressions: int) -> None:
        super().__init__()
        sliders = len(default_shares)
        self.counts = (sliders, expressions, NUMBERS)
        self.stem = nn.Conv2d(3, WIDTHS[0], 5, 2, 2, bias=False)
        self.stem_norm = nn.BatchNorm2d(WIDTHS[0])
        self.blocks = nn.Sequential(
            Block(WIDTHS[0], WIDTHS[1], 2),
            Block(WIDTHS[1], WIDTHS[2], 2),
            Block(WIDTHS[2], WIDTHS[2]),
            Block(WIDTHS[2], WIDTHS[3], 2),
            Block(WIDTHS[3], WIDTHS[3]),
        )
        self.squeeze = nn.Conv2d(WIDTHS[3], SQUEEZED, 1)
        self.seen = nn.Linear(SQUEEZED * CELLS * CELLS, HIDDEN)
        self.placed = nn.Linear(2 * COUNT, HIDDEN)
        self.placed_last = nn.Linear(HIDDEN, HIDDEN)
        self.middle = nn.Linear(2 * HIDDEN, HIDDEN)
        self.last = nn.Linear(HIDDEN, sum(self.counts))
        self.straight = nn.Linear(2 * COUNT, sum(self.counts), bias=False)
        self.register_buffer("template", torch.as_tensor(TEMPLATE, dtype=torch.float32))
        with torch.no_grad():  # untrained, it guesses the defaults
            for layer in (self.last, self.straight):
                layer.weight.zero_()
            self.last.bias.zero_()
            self.last.bias[:sliders] = default_shares

    def forward(self, images: Tensor | None, landmarks: Tensor) -> Output:
        """The guesses; without images those by the landmarks alone."""
        if images is None:
            picture = landmarks.new_zeros((len(landmarks), HIDDEN))
        else:
            with short_floats(self.training):  # twice as fast
                values = self.blocks(torch.relu(self.stem_norm(self.stem(images))))
                values = torch.relu(self.squeeze(values))
            picture = torch.relu(self.seen(values.float().flatten(1)))
        places = ((landmarks - self.template) / SPREAD).flatten(1)
        marks = torch.relu(self.placed_last(torch.relu(self.placed(places))))
        inner = torch.relu(self.middle(torch.cat([picture, marks], dim=1)))
        return Output(*(self.last(inner) + self.straight(places)).split(self.counts, dim=1))


def held(values: Tensor) -> Tensor:
    """Cut to 0..1, with gradients as if they were not: what was pushed out comes back."""
    return values + (values.clamp(0, 1) - values).detach()


def controls(subject: Subject) -> dict[str, Any]:
    """What a network's outputs stand for: sliders with their ranges, expressions, the axis that points up."""
    sliders = [
        {"name": slider.name, "range": [short(slider.minimum), short(slider.maximum)], "default": short(slider.default)}
        for slider in subject.free_sliders
    ]
    shapes = [subject.rig.shapes[i] for i in subject.expressions]
    return {"sliders": sliders, "expressions": shapes, "up_axis": subject.parts.up_axis}


def short(value: float) -> float:
    """Six digits: what a stage keeps of a number, and it is the same on every machine."""
    return float(f"{value:.6g}")


def start_graph(network: StartNetwork, metadata: Mapping[str, object]) -> bytes:
    """The bytes of an ONNX model of any batch, normalisation folded into convolutions.

    Inputs `image` (b, 3, 128, 128) as in the metadata's mean and std, `landmarks` (b, 68, 2) in sides of the crop;
    outputs `shares` (b, f) and `expressions` (b, e) in 0..1, `pose` (b, 7) as `CropSpace`.
    """
    write = GraphWriter()
    off = write.add("Sub", "landmarks", write.constant("template", network.template))
    places = write.add("Mul", write.reshape(off, -1, 2 * COUNT), write.constant("spread", np.array([1 / SPREAD])))
    at = write.add("Relu", write.conv("stem", "image", network.stem, network.stem_norm))
    for number, block in enumerate(network.blocks):
        at = write.block(f"block{number}", at, block)
    squeezed = write.add("Relu", write.conv("squeeze", at, network.squeeze))
    rows = write.reshape(squeezed, -1, network.seen.in_features)
    picture = write.add("Relu", write.linear("seen", rows, network.seen))
    marks = write.add(
        "Relu",
        write.linear(
            "placed_last", write.add("Relu", write.linear("placed", places, network.placed)), network.placed_last
        ),
    )
    inner = write.add("Relu", write.linear("middle", write.concat([picture, marks], 1), network.middle))
    straight = write.add("MatMul", places, write.constant("straight_weight", network.straight.weight.detach().T))
    values = write.add("Add", write.linear("last", inner, network.last), straight)
    # the parts of the last layer, held in 0..1 or in units
    sizes = {"shares": network.counts[0], "expressions": network.counts[1], "pose": NUMBERS}
    ends = np.cumsum([0, *network.counts]).tolist()
    low, high = write.constant("zero", np.zeros(())), write.constant("one", np.ones(()))
    for number, name in enumerate(("shares", "expressions")):
        if sizes[name]:
            write.add("Clip", write.slice(values, 1, ends[number], ends[number + 1]), low, high, name=name)
    scaled = write.add("Mul", write.slice(values, 1, ends[2], ends[3]), write.constant("pose_std", np.array(POSE_STD)))
    write.add("Add", scaled, write.constant("pose_mean", np.array(POSE_MEAN)), name="pose")
    operators = sorted({node.op_type for node in write.nodes})
    further = [name for name in operators if name in FURTHER_OPERATORS]
    described = {**metadata, "operators": operators, "further_operators": further}
    return write.to_bytes(
        "photo_start",
        {"image": (3, SIZE, SIZE), "landmarks": (COUNT, 2)},
        {name: (count,) for name, count in sizes.items() if count},
        {KEY: json.dumps(described, sort_keys=True)},
    )
