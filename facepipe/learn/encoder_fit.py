"""Training of the encoder of a neural rig on pairs of points and controls."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from facepipe.core.arrays import FloatArray
from facepipe.learn.encoder_descent import EncoderDescent, EncoderLimits
from facepipe.learn.encoder_last import last_layer
from facepipe.learn.encoder_network import EncoderNetwork, EncoderSize, as_tensor, first_weights
from facepipe.learn.one_thread import one_thread
from facepipe.learn.training_state import restoring

Array = npt.NDArray[Any]

LEAST_NOISE = 1e-3  # mm: straight maps stay within what float32 can tell


@dataclass(frozen=True, kw_only=True)
class EncoderSamples:
    """Frames of points, and of the controls that bring them there."""

    offsets: FloatArray  # (f, p, 3) millimetres from rest
    controls: FloatArray  # (f, c) from -1 to 1


@dataclass(frozen=True, kw_only=True)
class FittedEncoder:
    """Weights by the names of `facepipe.learn.encoder`, float32, and the steps taken."""

    weights: dict[str, FloatArray]
    steps: int


def train_encoder(
    samples: EncoderSamples,
    checked: EncoderSamples,
    places: FloatArray,
    straight: tuple[FloatArray, FloatArray],
    *,
    size: EncoderSize,
    noise: float,
    seed: int,
    limits: EncoderLimits,
    done: Callable[[], object] = lambda: None,
    state: Mapping[str, Array] | None = None,
    keep: Callable[[Mapping[str, Array]], object] = lambda _: None,
) -> FittedEncoder:
    """A network of least squared error beside a straight map, which it begins as.

    Adam with decoupled decay (Loshchilov and Hutter 2019) from a seed, on one thread: the same samples give the same
    network. It sees every frame with other noise each time. After it the straight map and the last layer are solved
    for once more, as the least squares of the features found.

    :param checked: other samples; training stops where their error has not fallen for some steps, and the best is
        taken
    :param places: (p, 3) of the points at rest
    :param straight: (3 p, c) and (c,): what the network is beside
    :param noise: standard deviation of a coordinate, millimetres
    :param done: called once for each step
    :param state: what `keep` was given in a training that was ended: it goes on from there
    :param keep: called with the state now and then, and in the end
    :raises InputError: a state of another training
    """
    with one_thread():
        random = torch.Generator().manual_seed(seed)
        learned, seen = [(as_tensor(one.offsets), as_tensor(one.controls)) for one in (samples, checked)]
        seen = (seen[0] + noise * torch.randn(seen[0].shape, generator=random), seen[1])
        network = EncoderNetwork(first_weights(learned[0], places, straight, size, random), places, size.heads)
        descent = EncoderDescent(network, learned, seen, noise, random, limits)
        if state is not None:
            with restoring():
                descent.go_on(state)
        descent.run(done, keep)
        found = {name: one.detach().numpy() for name, one in network.evaluated().items()}
        frames = [(x, network.reduced(x), y) for x, y in (learned, seen)]
        solved = zip(
            ("straight", "last", "offset"), last_layer(frames[0], frames[1], max(noise, LEAST_NOISE)), strict=True
        )
        found |= {name: one.astype(np.float32) for name, one in solved}
        return FittedEncoder(weights=found, steps=descent.steps)
