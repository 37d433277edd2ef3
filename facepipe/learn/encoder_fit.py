"""Training of the encoder of a neural rig on pairs of points and controls."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from facepipe.learn.encoder import Weights, evaluate, reduced
from facepipe.learn.encoder_last import last_layer
from facepipe.learn.one_thread import one_thread

FloatArray = npt.NDArray[np.floating]

BATCH = 64
FIRST_RATE, LAST_RATE = 5e-4, 1e-6
DECAY = 1.0  # of weights, a step and rate: the network bends no more than the frames ask for
LEAST_NOISE = 1e-3  # mm: straight maps stay within what float32 can tell
WARM = 100  # steps over which the rate rises
CHECK_EVERY = 50  # steps
_POINT_UNITS, _FEATURES = 32, 8
_FIXED = ("scale", "straight", "offset")


@dataclass(frozen=True, kw_only=True)
class EncoderSamples:
    """Frames of points, and of the controls that bring them there."""

    offsets: FloatArray  # (f, p, 3) millimetres from rest
    controls: FloatArray  # (f, c) from -1 to 1


@dataclass(frozen=True, kw_only=True)
class EncoderSize:
    """How large the network is."""

    per_token: int  # points; p is a multiple of it
    width: int  # of a token, a multiple of the heads
    layers: int
    heads: int
    reduced: int  # numbers that the global feature is reduced to


@dataclass(frozen=True, kw_only=True)
class EncoderLimits:
    """How long it is trained."""

    steps: int
    patience: int  # steps without a better check that end it


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
    """
    with one_thread():
        random = torch.Generator().manual_seed(seed)
        learned, seen = [(_tensor(one.offsets), _tensor(one.controls)) for one in (samples, checked)]
        seen = (seen[0] + noise * torch.randn(seen[0].shape, generator=random), seen[1])
        network = _Network(_begin(learned[0], places, straight, size, random), places, size.heads)
        taken = _descend(network, learned, seen, noise, random, limits, done)
        found = {name: one.detach().numpy() for name, one in network.evaluated().items()}
        frames = [(x, network.reduced(x), y) for x, y in (learned, seen)]
        solved = zip(
            ("straight", "last", "offset"), last_layer(frames[0], frames[1], max(noise, LEAST_NOISE)), strict=True
        )
        found |= {name: one.astype(np.float32) for name, one in solved}
        return FittedEncoder(weights=found, steps=taken)


class _Network:
    """Offsets (b, p, 3) to controls (b, c)."""

    def __init__(self, weights: Weights, places: FloatArray, heads: int) -> None:
        self._weights, self._heads = weights, heads
        self._places = _tensor((places - places.mean(axis=0)) / max(float(places.std(axis=0).max()), 1e-9))
        self.learned = [one.requires_grad_() for name, one in weights.items() if name not in _FIXED]

    def evaluated(self) -> Weights:
        """The weights as they are evaluated: what a point's place brings is a bias of the point."""
        point, bias = self._weights["point"], self._weights["point_bias"]
        return self._weights | {"point": point[:3], "point_bias": self._places @ point[3:] + bias}

    def __call__(self, offsets: Tensor) -> Tensor:
        return evaluate(self.evaluated(), offsets, self._heads)

    def reduced(self, offsets: Tensor) -> Tensor:
        """(f, r) without gradients, a few frames at a time."""
        weights = self.evaluated()
        with torch.no_grad():
            return torch.cat([reduced(weights, some, self._heads) for some in offsets.split(4 * BATCH)])

    def copied(self) -> list[Tensor]:
        """The parameters as they are now."""
        return [one.detach().clone() for one in self.learned]

    def restore(self, copies: list[Tensor]) -> None:
        """Set the parameters to what they were."""
        with torch.no_grad():
            for one, copy in zip(self.learned, copies, strict=True):
                one.copy_(copy)


def _begin(
    offsets: Tensor,
    places: FloatArray,
    straight: tuple[FloatArray, FloatArray],
    size: EncoderSize,
    random: torch.Generator,
) -> Weights:
    """The weights to begin with; the last layer is 0."""

    def drawn(rows: int, columns: int) -> Tensor:
        return (torch.rand(rows, columns, generator=random) * 2 - 1) / math.sqrt(rows)

    count, controls, width = len(places) // size.per_token, len(straight[1]), size.width
    weights = {
        "scale": offsets.square().mean().sqrt().clamp_min(1e-6),
        "straight": _tensor(straight[0]),
        "offset": _tensor(straight[1]),
        "point": drawn(6, _POINT_UNITS),  # of offset and place
        "point_bias": drawn(1, _POINT_UNITS)[0],
        "feature": drawn(_POINT_UNITS, _FEATURES),
        "feature_bias": torch.zeros(_FEATURES),
        "token": drawn(size.per_token * _FEATURES, width),
        "places": 0.1 * torch.randn(count, width, generator=random),
        "reduce": drawn(count * width, size.reduced),
        "reduce_bias": torch.zeros(size.reduced),
        "last": torch.zeros(size.reduced, controls),
    }
    for layer in range(size.layers):
        for name, (rows, columns) in {
            "attend": (width, 3 * width),
            "join": (width, width),
            "widen": (width, 2 * width),
            "narrow": (2 * width, width),
        }.items():
            weights[f"{layer}.{name}"] = drawn(rows, columns)
            weights[f"{layer}.{name}_bias"] = torch.zeros(columns)
    return weights


def _descend(
    network: _Network,
    samples: tuple[Tensor, Tensor],
    checked: tuple[Tensor, Tensor],
    noise: float,
    random: torch.Generator,
    limits: EncoderLimits,
    done: Callable[[], object],
) -> int:
    """Train in place; returns the steps taken."""
    offsets, controls = samples
    optimiser = torch.optim.AdamW(network.learned, lr=FIRST_RATE, weight_decay=DECAY)
    best, best_step, kept = _error(network, checked), 0, network.copied()
    for step in range(1, limits.steps + 1):
        optimiser.param_groups[0]["lr"] = _rate(step, limits.steps)
        rows = torch.randint(len(offsets), (BATCH,), generator=random)
        seen = offsets[rows] + noise * torch.randn(BATCH, *offsets.shape[1:], generator=random)
        optimiser.zero_grad()
        loss = (network(seen) - controls[rows]).square().mean()
        loss.backward()
        optimiser.step()
        done()
        if step % CHECK_EVERY == 0 or step == limits.steps:
            error = _error(network, checked)
            if error < best:
                best, best_step, kept = error, step, network.copied()
            elif step - best_step >= limits.patience:
                break
    network.restore(kept)
    return step


def _rate(step: int, steps: int) -> float:
    """Up over the first steps, then down along a cosine."""
    down = LAST_RATE + (FIRST_RATE - LAST_RATE) * (1.0 + math.cos(math.pi * step / steps)) / 2.0
    return down * min(1.0, step / WARM)


def _error(network: _Network, checked: tuple[Tensor, Tensor]) -> float:
    """Mean square of what held-out frames are off."""
    with torch.no_grad():
        pieces = zip(checked[0].split(4 * BATCH), checked[1].split(4 * BATCH), strict=True)
        total = sum((float((network(x) - y).square().sum()) for x, y in pieces), 0.0)
        return float(total / checked[1].numel())


def _tensor(values: FloatArray) -> Tensor:
    return torch.as_tensor(np.asarray(values, dtype=np.float32))
