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
from facepipe.rig.neural_rig import EPSILON, EncoderLayer
from facepipe.rig.torch.descent import Descent
from facepipe.rig.torch.one_thread import one_thread

Weights = dict[str, Tensor]

LAYER = ("attend", "attend_bias", "join", "join_bias", "widen", "widen_bias", "narrow", "narrow_bias")
_DOUBTS = (0.003, 0.01, 0.03, 0.1, 0.3, 10.0)  # noise of reduced features, within -1..1: with the last, none counts
BATCH = 64
FIRST_RATE, LAST_RATE = 5e-4, 1e-6
DECAY = 1.0  # of weights, a step and rate: the network bends no more than the frames ask for
WARM = 100  # steps over which the rate rises
LEAST_NOISE = 1e-3  # mm: straight maps stay within what float32 resolves


assert set(LAYER) == set(EncoderLayer.__dataclass_fields__)
_POINT_UNITS, _FEATURES = 32, 8
_FIXED = ("scale", "straight", "offset")
_AT_ONCE = 256  # frames


def reduced(weights: Weights, offsets: Tensor, heads: int) -> Tensor:
    """(b, r) from -1 to 1: what a face is reduced to before its controls are found; as `evaluate`."""
    batch, count = len(offsets), len(weights["places"])
    hidden = torch.tanh(offsets / weights["scale"] @ weights["point"] + weights["point_bias"])
    features = hidden @ weights["feature"] + weights["feature_bias"]
    tokens = features.reshape(batch, count, -1) @ weights["token"] + weights["places"]
    number = 0
    while f"{number}.attend" in weights:
        layer = {name: weights[f"{number}.{name}"] for name in LAYER}
        # attention of each token to all, by several heads
        found = (_norm(tokens) @ layer["attend"] + layer["attend_bias"]).reshape(batch, count, 3, heads, -1)
        queries, keys, values = found.permute(2, 0, 3, 1, 4)
        shares = torch.softmax(queries @ keys.transpose(-1, -2) / math.sqrt(queries.shape[-1]), dim=-1)
        joined = (shares @ values).transpose(1, 2).reshape(batch, count, -1)
        tokens = tokens + (joined @ layer["join"] + layer["join_bias"])
        wide = torch.relu(_norm(tokens) @ layer["widen"] + layer["widen_bias"])
        tokens = tokens + wide @ layer["narrow"] + layer["narrow_bias"]
        number += 1
    return torch.tanh(tokens.reshape(batch, -1) @ weights["reduce"] + weights["reduce_bias"])


def evaluate(weights: Weights, offsets: Tensor, heads: int) -> Tensor:
    """(b, c) from about -1 to 1, not clamped, of offsets from rest (b, p, 3) in millimetres.

    :param weights: by the names of `NeuralEncoder`; those of layer i are called ``i.attend`` ...; ``scale`` is one too
    """
    flat = offsets.reshape(len(offsets), -1)
    return reduced(weights, offsets, heads) @ weights["last"] + flat @ weights["straight"] + weights["offset"]


def _norm(tokens: Tensor) -> Tensor:
    return torch.nn.functional.layer_norm(tokens, tokens.shape[-1:], eps=EPSILON)


@dataclass(frozen=True, kw_only=True)
class EncoderSize:
    """How large the network is."""

    per_token: int  # points; p is a multiple of it
    width: int  # of a token, a multiple of the heads
    layers: int
    heads: int
    reduced: int  # numbers that the global feature is reduced to


class EncoderNetwork:
    """Offsets (b, p, 3) to controls (b, c)."""

    def __init__(self, weights: Weights, places: FloatArray, heads: int) -> None:
        self._weights, self._heads = weights, heads
        self._places = as_tensor((places - places.mean(axis=0)) / max(float(places.std(axis=0).max()), 1e-9))
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
            return torch.cat([reduced(weights, some, self._heads) for some in offsets.split(_AT_ONCE)])

    def error(self, offsets: Tensor, controls: Tensor) -> float:
        """Mean square of what frames are off."""
        with torch.no_grad():
            pieces = zip(offsets.split(_AT_ONCE), controls.split(_AT_ONCE), strict=True)
            total = sum((float((self(x) - y).square().sum()) for x, y in pieces), 0.0)
            return float(total / controls.numel())


def first_weights(
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
        "straight": as_tensor(straight[0]),
        "offset": as_tensor(straight[1]),
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


def as_tensor(values: FloatArray) -> Tensor:
    """In float32."""
    return torch.as_tensor(np.asarray(values, dtype=np.float32))


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
) -> tuple[dict[str, FloatArray], int]:
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
    :returns: weights by their names in the network, float32, and the steps taken
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
        return weights, descent.steps
