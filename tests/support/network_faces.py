"""Learned networks of sliders for tests."""

from __future__ import annotations

import itertools
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from faces import tiny_face

from facepipe.parts import Curve, FaceParts, Slider, SliderNetwork

CURVE: Curve = ((0.0, 0.0), (0.4, 0.1), (1.0, 1.0))
SLIDERS = (
    Slider(name="jaw", channels=(("root/jaw", "rx", 0.5), ("root/jaw/lip", "tx", 0.2)), channel_curves=(CURVE, None)),
    Slider(name="lip", minimum=-1.0, maximum=1.5, default=0.25, channels=(("root/jaw/lip", "ty", -0.3),)),
    Slider(name="smile", shapes=(("mouthSmileLeft", 0.9), ("jawOpen", 0.2)), shape_curves=(None, CURVE)),
    Slider(name="still", minimum=0.5, maximum=0.5, default=0.5, channels=(("root", "tz", 0.1),)),
    Slider(name="straight", minimum=-2.0, channels=(("root", "sz", 0.05),)),
)
CHANNELS = (("root/jaw", "rx"), ("root/jaw", "tz"), ("root/jaw/lip", "sy"))


def network(
    hidden: Sequence[int] = (16,),
    activation: Literal["tanh", "relu", "silu"] = "tanh",
    seed: int = 0,
    size: float = 0.1,
) -> SliderNetwork:
    """A random network over four sliders of `SLIDERS`, one of a single value, that adds to bones and shapes."""
    random = np.random.default_rng(seed)
    sizes = [4, *hidden, 5]
    layers = [random.normal(size=(out, into)) / np.sqrt(into) for into, out in itertools.pairwise(sizes)]
    layers[-1] *= size
    return SliderNetwork(
        sliders=("smile", "jaw", "still", "lip"),
        channels=CHANNELS,
        shapes=("jawOpen", "mouthSmileLeft"),
        weights=tuple(layer.astype(np.float32) for layer in layers),
        biases=tuple((random.normal(size=out) * size).astype(np.float32) for out in sizes[1:]),
        activation=activation,
        info={"trained_on": "nothing"},
    )


def networked(own: SliderNetwork | None) -> FaceParts:
    """The tiny face with `SLIDERS` and a network."""
    return replace(tiny_face(), sliders=SLIDERS, slider_network=own)


def save_network(path: Path, own: SliderNetwork, **changes: Any) -> Path:
    """The file that training code saves of a network, outputs in another order than on the face."""
    outputs = [f"{joint.rpartition('/')[2]}:{channel}" for joint, channel in own.channels]
    outputs += [f"shape:{shape}" for shape in own.shapes]
    turned = slice(None, None, -1)
    arrays: dict[str, Any] = {"sliders": own.sliders, "outputs": outputs[turned], "activation": own.activation}
    for i, (weight, bias) in enumerate(zip(own.weights, own.biases, strict=True)):
        last = i == len(own.weights) - 1
        arrays |= {
            f"layer{i}.weight": weight[turned] if last else weight,
            f"layer{i}.bias": bias[turned] if last else bias,
        }
    arrays |= {"info": json.dumps(dict(own.info))} | changes
    np.savez(path, **{name: values for name, values in arrays.items() if values is not None})
    return path
