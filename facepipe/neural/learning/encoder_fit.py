"""Training of the encoder of a neural rig on pairs of points and controls.

The straight map and the last layer are then solved for together.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from facepipe.core.arrays import AnyArray, FloatArray
from facepipe.geometry.ridge import ridge
from facepipe.neural.learning.encoder_network import EncoderNetwork, EncoderSize, as_tensor, first_weights
from facepipe.rig.torch.descent import Descent
from facepipe.rig.torch.one_thread import one_thread

_DOUBTS = (0.003, 0.01, 0.03, 0.1, 0.3, 10.0)  # noise of reduced features, within -1..1: with the last, none counts
BATCH = 64
FIRST_RATE, LAST_RATE = 5e-4, 1e-6
DECAY = 1.0  # of weights, a step and rate: the network bends no more than the frames ask for
WARM = 100  # steps over which the rate rises
LEAST_NOISE = 1e-3  # mm: straight maps stay within what float32 resolves


def last_layer(
    taught: tuple[Tensor, Tensor, Tensor], watched: tuple[Tensor, Tensor, Tensor], noise: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The straight map (3 p, c), the last layer (r, c) and the offset (c,) of least squared error, of given features.

    Features were fitted to the frames, so they are trusted less than these say: by as much as is best for the watched
    frames. The maps are then those of all frames.

    :param taught: offsets (f, p, 3) in millimetres, reduced features (f, r) and controls (f, c) that training saw
    :param watched: others, that it did not see
    :param noise: of offsets, millimetres
    """
    rows, others = _rows(*taught), _rows(*watched)
    coordinates = taught[0][0].numel()

    def solved(seen: FloatArray, targets: FloatArray, doubt: float) -> tuple[FloatArray, FloatArray]:
        noises = np.full(seen.shape[1], doubt)
        noises[:coordinates] = noise
        return ridge(seen, targets, noises)

    def error(doubt: float) -> float:
        matrix, offset = solved(*rows, doubt)
        return float(np.square(np.clip(others[0] @ matrix + offset, -1.0, 1.0) - others[1]).mean())

    # The doubt is chosen on frames not taught; with all frames solved for, each doubt would look best at its least.
    together = [np.concatenate(pair) for pair in zip(rows, others, strict=True)]
    matrix, offset = solved(together[0], together[1], min(_DOUBTS, key=error))
    return matrix[:coordinates], matrix[coordinates:], offset


def _rows(offsets: Tensor, features: Tensor, controls: Tensor) -> tuple[FloatArray, FloatArray]:
    pieces = [one.numpy().astype(np.float64).reshape(len(one), -1) for one in (offsets, features)]
    return np.concatenate(pieces, axis=1), controls.numpy().astype(np.float64)


class EncoderDescent(Descent):
    """Adam with decoupled decay on frames with other noise each time."""

    check_every, keep_every = 50, 100

    def __init__(
        self,
        network: EncoderNetwork,
        samples: tuple[Tensor, Tensor],
        checked: tuple[Tensor, Tensor],
        noise: float,
        random: torch.Generator,
        *,
        steps: int,
        patience: int,
    ) -> None:
        """
        :param samples: offsets (f, p, 3) in millimetres and controls (f, c)
        :param checked: others; the network that is best there is kept
        :param noise: standard deviation of a coordinate, millimetres
        """
        self._network, self._samples, self._checked, self._noise = network, samples, checked, noise
        optimiser = torch.optim.AdamW(network.learned, lr=FIRST_RATE, weight_decay=DECAY)
        super().__init__(network.learned, optimiser, random, steps=steps, patience=patience)
        self._best = self.error()

    def rate(self, step: int) -> float:
        """Up over the first, then down along a cosine."""
        down = LAST_RATE + (FIRST_RATE - LAST_RATE) * (1.0 + math.cos(math.pi * step / self._most)) / 2.0
        return down * min(1.0, step / WARM)

    def loss(self) -> Tensor:
        """Of the next batch."""
        offsets, controls = self._samples
        rows = torch.randint(len(offsets), (BATCH,), generator=self._random)
        seen = offsets[rows] + self._noise * torch.randn(BATCH, *offsets.shape[1:], generator=self._random)
        return (self._network(seen) - controls[rows]).square().mean()

    def error(self) -> float:
        """Of the samples that are checked."""
        return self._network.error(*self._checked)


@dataclass(frozen=True, kw_only=True)
class EncoderSamples:
    """Frames of points, and of the controls that bring them there."""

    offsets: FloatArray  # (f, p, 3) millimetres from rest
    controls: FloatArray  # (f, c) from -1 to 1


@dataclass(frozen=True, kw_only=True)
class FittedEncoder:
    """Weights by the names of `facepipe.neural.learning.encoder_network`, float32, and the steps taken."""

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
    steps: int,
    patience: int,
    done: Callable[[], object] = lambda: None,
    state: Mapping[str, AnyArray] | None = None,
    keep: Callable[[Mapping[str, AnyArray]], object] = lambda _: None,
) -> FittedEncoder:
    """A network of least squared error beside a straight map, which it begins as.

    Adam with decoupled decay (Loshchilov and Hutter 2019) from a seed, on one thread: the same samples give the same
    network. It sees every frame with other noise each time. After it the straight map and the last layer are solved
    for once more, as the least squares of the features found.

    :param checked: other samples; training stops where their error has not fallen for `patience` steps, and the best is
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
        # Drawn once, unlike that of the learned: errors of different steps are compared.
        seen = (seen[0] + noise * torch.randn(seen[0].shape, generator=random), seen[1])
        network = EncoderNetwork(first_weights(learned[0], places, straight, size, random), places, size.heads)
        descent = EncoderDescent(network, learned, seen, noise, random, steps=steps, patience=patience)
        if state is not None:
            descent.go_on(state)
        descent.run(done, keep)
        weights = {name: one.detach().numpy() for name, one in network.evaluated().items()}
        frames = [(x, network.reduced(x), y) for x, y in (learned, seen)]
        solved = zip(
            ("straight", "last", "offset"), last_layer(frames[0], frames[1], max(noise, LEAST_NOISE)), strict=True
        )
        weights |= {name: one.astype(np.float32) for name, one in solved}
        return FittedEncoder(weights=weights, steps=descent.steps)
