"""The encoder of a neural rig, points to controls, as `facepipe.rig.neural_encoder` defines it, with gradients."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from facepipe.rig.neural_encoder import EPSILON, EncoderLayer

Weights = dict[str, Tensor]

LAYER = ("attend", "attend_bias", "join", "join_bias", "widen", "widen_bias", "narrow", "narrow_bias")
assert set(LAYER) == set(EncoderLayer.__dataclass_fields__)


def reduced(weights: Weights, offsets: Tensor, heads: int) -> Tensor:
    """(b, r) from -1 to 1: what a face is reduced to before its controls are told; as `evaluate`."""
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
