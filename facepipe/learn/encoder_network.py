"""The encoder of a neural rig while it is trained: its weights, from their first draw on."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from facepipe.core.arrays import FloatArray
from facepipe.learn.encoder import Weights, evaluate, reduced

_POINT_UNITS, _FEATURES = 32, 8
_FIXED = ("scale", "straight", "offset")
_AT_ONCE = 256  # frames


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

    def copied(self) -> list[Tensor]:
        """The parameters as they are now."""
        return [one.detach().clone() for one in self.learned]

    def restore(self, copies: list[Tensor]) -> None:
        """Set the parameters to what they were."""
        with torch.no_grad():
            for one, copy in zip(self.learned, copies, strict=True):
                one.copy_(copy)


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
