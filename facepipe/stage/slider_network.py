"""The learned network of a face's sliders on the face prim: read and authored."""

from __future__ import annotations

import json
from itertools import accumulate, pairwise
from typing import Any

import numpy as np
from pxr import Usd

from facepipe.core import tokens
from facepipe.core.errors import FacepipeError, InputError, SchemaError
from facepipe.core.reading import check_values
from facepipe.parts import FaceParts, SliderNetwork
from facepipe.rig.slider_network import network_fault
from facepipe.stage.api_schemas import apply_schema, is_applied, put, put_value, remove_schema
from facepipe.stage.differences import same
from facepipe.stage.guard import reads_prim
from facepipe.stage.values import floats, ints, to_floats

_NETWORK_PREFIX = tokens.NETWORK_LAYERS.rpartition(":")[0]


@reads_prim
def read_slider_network(prim: Usd.Prim) -> SliderNetwork | None:
    """The network on a face prim; None where there is none.

    :raises SchemaError: lists that are not parallel, numbers that are not those of its layers, or a damaged network
    """
    if not is_applied(prim, tokens.SLIDER_NETWORK_API):
        return None

    def value(name: str) -> Any:
        return prim.GetAttribute(name).Get()

    def words(name: str) -> tuple[str, ...]:
        return tuple(str(word) for word in value(name) or ())

    where = f"{prim.GetPath()}.{_NETWORK_PREFIX}"
    joints, channels = words(tokens.NETWORK_JOINTS), words(tokens.NETWORK_CHANNELS)
    if len(joints) != len(channels):
        raise SchemaError(where, f"{len(joints)} joints and {len(channels)} channels, expected as many of each")
    layers = ints(value(tokens.NETWORK_LAYERS)).tolist()
    weights, biases = floats(value(tokens.NETWORK_WEIGHTS)), floats(value(tokens.NETWORK_BIASES))
    if len(layers) < 2 or min(layers) < 1:
        raise SchemaError(
            f"{prim.GetPath()}.{tokens.NETWORK_LAYERS}", f"{layers[:8]}, expected 2 numbers or more from 1"
        )
    sizes = [into * out for into, out in pairwise(layers)]
    if (len(weights), len(biases)) != (sum(sizes), sum(layers[1:])):
        found = f"{len(weights)} weights and {len(biases)} biases"
        raise SchemaError(where, f"{found}, expected {sum(sizes)} and {sum(layers[1:])} for layers {layers[:8]}")
    network = SliderNetwork(
        sliders=words(tokens.NETWORK_SLIDERS),
        channels=tuple(zip(joints, channels, strict=True)),
        shapes=words(tokens.NETWORK_SHAPES),
        weights=tuple(
            part.reshape(out, into)
            for part, (into, out) in zip(np.split(weights, list(accumulate(sizes))[:-1]), pairwise(layers), strict=True)
        ),
        biases=tuple(np.split(biases, list(accumulate(layers[1:]))[:-1])),
        activation=str(value(tokens.NETWORK_ACTIVATION) or "tanh"),  # type: ignore[arg-type]
        info=_info(prim, str(value(tokens.NETWORK_INFO) or "{}")),
    )
    fault = network_fault(network)
    if fault:
        raise SchemaError(where, fault)
    return network


def _info(prim: Usd.Prim, text: str) -> dict[str, object]:
    where = f"{prim.GetPath()}.{tokens.NETWORK_INFO}"
    check_values(where, text.encode())
    try:
        info = json.loads(text)
    except (ValueError, RecursionError):
        info = None
    if not isinstance(info, dict):
        raise SchemaError(where, "no JSON object, expected one")
    return info


def check_face_network(where: object, parts: FaceParts, error: type[FacepipeError] = InputError) -> None:
    """Check that the network of a face is whole, and that the face has its sliders.

    :raises error: a damaged network, or one of sliders that the face lacks
    """
    network = parts.slider_network
    if network is None:
        return
    fault = network_fault(network)
    known = {slider.name for slider in parts.sliders}
    gone = [name for name in network.sliders if name not in known]
    if fault or gone:
        raise error(f"{where} -> slider network", fault or f"no slider '{gone[0]}'")


def author_slider_network(prim: Usd.Prim, network: SliderNetwork) -> None:
    """Apply a network to the face prim."""
    apply_schema(prim, tokens.SLIDER_NETWORK_API)
    for name, value in (
        (tokens.NETWORK_SLIDERS, list(network.sliders)),
        (tokens.NETWORK_JOINTS, [joint for joint, _ in network.channels]),
        (tokens.NETWORK_CHANNELS, [channel for _, channel in network.channels]),
        (tokens.NETWORK_SHAPES, list(network.shapes)),
        (tokens.NETWORK_LAYERS, network.layers),
        (tokens.NETWORK_WEIGHTS, to_floats(np.concatenate([weight.ravel() for weight in network.weights]))),
        (tokens.NETWORK_BIASES, to_floats(np.concatenate(network.biases))),
        (tokens.NETWORK_ACTIVATION, network.activation),
        (tokens.NETWORK_INFO, json.dumps(dict(network.info), sort_keys=True) if network.info else ""),
    ):
        put_value(prim, name, value)


def author_network_change(prim: Usd.Prim, old: SliderNetwork | None, new: SliderNetwork | None) -> tuple[str, ...]:
    """Author on the face prim the network where it differs, or hide the one that is gone; a line for it."""
    if same(old, new):
        return ()
    if new is not None:
        author_slider_network(prim, new)
        return ("slider network",)
    for attribute in prim.GetAuthoredPropertiesInNamespace(_NETWORK_PREFIX):
        put(attribute, None)
    remove_schema(prim, tokens.SLIDER_NETWORK_API)
    return ("slider network removed",)
