"""The network for first guesses as an ONNX graph, written node by node."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from facepipe.photo.amortised.network import COUNT, MEAN, SIZE, SPREAD, STD, StartNetwork
from facepipe.photo.amortised.training import POSE_MEAN, POSE_STD
from facepipe.photo.descent.subject import NUMBERS, Subject
from facepipe.rig.torch.graph_writer import GraphWriter

if TYPE_CHECKING:
    from facepipe.photo.amortised.training import Trained
    from facepipe.photo.options import StartOptions

KEY = "facepipe.photo"
KIND = "photo-start"
_CONVENTIONS = {
    "image": "(b, 3, size, size) RGB, sRGB 0..1 less mean over std, the crop 'face' by the 68 landmarks",
    "landmarks": "(b, 68, 2) x right, y down, in sides of the crop from its top left corner",
    "shares": "0..1 of the sliders' ranges, in their order",
    "expressions": "weights 0..1 of the expressions, in their order",
    "pose": "rotation vector (3, radians) from facing the viewer, along the line of sight; middle of the head (2) and "
    "logarithm of its size in sides of the crop; logarithm of its distance in head heights",
}
FURTHER_OPERATORS = ("Conv",)  # beside those that every engine has for per-frame graphs


def controls(subject: Subject) -> dict[str, Any]:
    """What a network's outputs stand for: sliders with their ranges, expressions, the axis that points up."""
    sliders = [
        {
            "name": slider.name,
            "range": [_short(slider.minimum), _short(slider.maximum)],
            "default": _short(slider.default),
        }
        for slider in subject.free_sliders
    ]
    shapes = [subject.rig.shapes[i] for i in subject.expressions]
    return {"sliders": sliders, "expressions": shapes, "up_axis": subject.parts.up_axis}


def start_metadata(trained: Trained, options: StartOptions) -> dict[str, Any]:
    """As JSON; how it was trained without the names of files."""
    flags = {name: getattr(options, name) for name in ("people", "renders", "epochs", "steps", "seed")}
    photos = f"{trained.photos} photos without labels, after " if trained.photos else ""
    images = "--images DIR " if trained.photos else ""
    return {
        "kind": KIND,
        "face": trained.subject.parts.name,
        **controls(trained.subject),
        "size": SIZE,
        "crop": "face",
        "mean": [MEAN] * 3,
        "std": [STD] * 3,
        "order": "RGB",
        "conventions": _CONVENTIONS,
        "trained_on": f"{photos}{options.renders} renders of FACE",
        "training": f"facepipe train-photo FACE -o OUT {images}"
        + " ".join(f"--{name} {value}" for name, value in flags.items()),
        **flags,
        "held_out": {
            "pictures": trained.held_out,
            "before": {name: _short(value) for name, value in trained.before.items()},
            "after": {name: _short(value) for name, value in trained.after.items()},
        },
    }


def _short(value: float) -> float:
    """Six digits: what a stage keeps of a number, and it is the same on every machine."""
    return float(f"{value:.6g}")


def start_graph(network: StartNetwork, metadata: Mapping[str, object]) -> bytes:
    """The bytes of an ONNX model of any batch, normalisation folded into convolutions.

    Inputs `image` (b, 3, 128, 128) as in the metadata's mean and std, `landmarks` (b, 68, 2) in sides of the crop;
    outputs `shares` (b, f) and `expressions` (b, e) in 0..1, `pose` (b, 7) as `CropSpace`.

    :param metadata: as ``facepipe.photo``
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
