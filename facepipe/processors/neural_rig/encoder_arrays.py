"""Encoders as named arrays and JSON: their part of a neural rig's file."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from facepipe.core.errors import InputError
from facepipe.processors.database.array_file import Content
from facepipe.processors.neural_rig.control_json import controls_from
from facepipe.rig.neural_encoder import EncoderLayer, NeuralEncoder

KEY = "encoder"
_FLOATS: tuple[str, ...] = ("rest", "point", "point_bias", "feature", "feature_bias", "token", "places")
_FLOATS += ("reduce", "reduce_bias", "last", "straight", "offset")
_LAYER = tuple(one.name for one in dataclasses.fields(EncoderLayer))


def to_arrays(encoder: NeuralEncoder) -> tuple[dict[str, Any], dict[str, npt.NDArray[Any]]]:
    """JSON, and arrays of float32 and int32 whose names begin with ``encoder.``."""
    content = {
        "controls": [dataclasses.asdict(control) for control in encoder.controls],
        "heads": encoder.heads,
        "layers": len(encoder.layers),
        "point_count": encoder.point_count,
        "scale": encoder.scale,
        "topology": encoder.topology,
    }
    arrays = {name: getattr(encoder, name).astype(np.float32) for name in _FLOATS}
    for number, layer in enumerate(encoder.layers):
        arrays |= {f"{number}.{name}": getattr(layer, name).astype(np.float32) for name in _LAYER}
    named = {f"{KEY}.{name}": array for name, array in arrays.items()}
    return content, {**named, f"{KEY}.chosen": encoder.chosen.astype(np.int32)}


def from_arrays(where: object, found: Content) -> NeuralEncoder:
    """What `to_arrays` made.

    :raises InputError: no encoder, or a damaged one
    """
    content = found.content.get(KEY)
    if content is None:
        raise InputError(where, "has no encoder, expected a neural rig that was trained with one")
    try:
        layers = tuple(EncoderLayer(**_named(found, f"{i}.", _LAYER)) for i in range(int(content["layers"])))
        encoder = NeuralEncoder(
            controls=controls_from(content["controls"], f"{where} -> {KEY} -> controls"),
            topology=str(content["topology"]),
            point_count=int(content["point_count"]),
            chosen=np.asarray(found.arrays[f"{KEY}.chosen"], np.int64),
            scale=float(content["scale"]),
            heads=int(content["heads"]),
            layers=layers,
            **_named(found, "", _FLOATS),
        )
        _check(where, encoder)
    except (LookupError, TypeError, ValueError, OverflowError) as error:
        raise InputError(where, f"its encoder is damaged ({error}), expected a whole one") from None
    return encoder


def _named(found: Content, prefix: str, names: tuple[str, ...]) -> Mapping[str, Any]:
    return {name: np.asarray(found.arrays[f"{KEY}.{prefix}{name}"], np.float64) for name in names}


def _check(where: object, encoder: NeuralEncoder) -> None:
    for name, shape in shapes(encoder).items():
        own: Any = encoder
        if "." in name:
            number, name_of = name.split(".")
            own, name = encoder.layers[int(number)], name_of
        if getattr(own, name).shape != shape:
            raise InputError(f"{where} -> {KEY}.{name}", f"shape {getattr(own, name).shape}, expected {shape}")
    low, high = encoder.chosen.min(initial=0), encoder.chosen.max(initial=0)
    if low < 0 or high >= encoder.point_count:
        what = f"points {low} to {high}, expected some of {encoder.point_count}"
        raise InputError(f"{where} -> {KEY}.chosen", what)
    if encoder.heads < 1 or encoder.token.shape[1] % encoder.heads or not 0.0 < encoder.scale < np.inf:
        what = f"{encoder.heads} heads for tokens of {encoder.token.shape[1]}, scale {encoder.scale:g}"
        raise InputError(f"{where} -> {KEY}", f"{what}, expected heads that share a token evenly and a scale above 0")


def shapes(encoder: NeuralEncoder) -> dict[str, tuple[int, ...]]:
    """Array -> the shape that it has if it fits the others; those of layer i are called ``i.attend`` ..."""
    points, controls = len(encoder.chosen), len(encoder.controls)
    tokens, units, features = max(len(encoder.places), 1), encoder.point.shape[-1], len(encoder.feature_bias)
    width, reduced = encoder.token.shape[-1], len(encoder.reduce_bias)
    found: dict[str, tuple[int, ...]] = {
        "chosen": (points // tokens * tokens,),
        "rest": (points, 3),
        "point": (3, units),
        "point_bias": (points, units),
        "feature": (units, features),
        "feature_bias": (features,),
        "token": (points // tokens * features, width),
        "places": (tokens, width),
        "reduce": (tokens * width, reduced),
        "reduce_bias": (reduced,),
        "last": (reduced, controls),
        "straight": (3 * points, controls),
        "offset": (controls,),
    }
    for number, layer in enumerate(encoder.layers):
        wide = len(layer.widen_bias)
        own: tuple[tuple[int, ...], ...] = ((width, 3 * width), (3 * width,), (width, width), (width,))
        own += ((width, wide), (wide,), (wide, width), (width,))
        found |= {f"{number}.{name}": shape for name, shape in zip(_LAYER, own, strict=True)}
    return found
