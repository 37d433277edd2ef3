"""The encoder of a neural rig, points to controls, as `facepipe.rig.neural_encoder` defines it, with gradients."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from facepipe.core.arrays import FloatArray
from facepipe.rig.neural_encoder import EPSILON, EncoderLayer

Weights = dict[str, Tensor]

LAYER = ("attend", "attend_bias", "join", "join_bias", "widen", "widen_bias", "narrow", "narrow_bias")
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
        tokens = tokens + _attention(_norm(tokens), layer, heads)
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


def _attention(tokens: Tensor, layer: Weights, heads: int) -> Tensor:
    batch, count, width = tokens.shape
    found = (tokens @ layer["attend"] + layer["attend_bias"]).reshape(batch, count, 3, heads, width // heads)
    queries, keys, values = found.permute(2, 0, 3, 1, 4)
    shares = torch.softmax(queries @ keys.transpose(-1, -2) / math.sqrt(width / heads), dim=-1)
    joined = (shares @ values).transpose(1, 2).reshape(batch, count, width)
    return joined @ layer["join"] + layer["join_bias"]


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
