"""Learned networks of sliders for tests."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

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
        weights=tuple(one.astype(np.float32) for one in layers),
        biases=tuple((random.normal(size=out) * size).astype(np.float32) for out in sizes[1:]),
        activation=activation,
        info={"trained_on": "nothing"},
    )


def networked(own: SliderNetwork | None) -> FaceParts:
    """The tiny face with `SLIDERS` and a network."""
    return replace(tiny_face(), sliders=SLIDERS, slider_network=own)
