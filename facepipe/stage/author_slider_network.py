"""The learned network of a face's sliders, authored on the face prim."""

from __future__ import annotations

import json

import numpy as np
from pxr import Usd

from facepipe.core import tokens
from facepipe.parts import SliderNetwork
from facepipe.stage.api_schemas import apply_schema, put, put_value, remove_schema
from facepipe.stage.differences import same
from facepipe.stage.values import to_floats

_PREFIX = tokens.NETWORK_LAYERS.rpartition(":")[0]


def author_slider_network(prim: Usd.Prim, network: SliderNetwork) -> None:
    """Apply a network to the face prim."""
    apply_schema(prim, tokens.SLIDER_NETWORK_API)
    layers = [len(network.sliders), *(len(bias) for bias in network.biases)]
    for name, found in (
        (tokens.NETWORK_SLIDERS, list(network.sliders)),
        (tokens.NETWORK_JOINTS, [joint for joint, _ in network.channels]),
        (tokens.NETWORK_CHANNELS, [channel for _, channel in network.channels]),
        (tokens.NETWORK_SHAPES, list(network.shapes)),
        (tokens.NETWORK_LAYERS, layers),
        (tokens.NETWORK_WEIGHTS, to_floats(np.concatenate([one.ravel() for one in network.weights]))),
        (tokens.NETWORK_BIASES, to_floats(np.concatenate(network.biases))),
        (tokens.NETWORK_ACTIVATION, network.activation),
        (tokens.NETWORK_INFO, json.dumps(dict(network.info), sort_keys=True) if network.info else ""),
    ):
        put_value(prim, name, found)


def author_network_change(prim: Usd.Prim, old: SliderNetwork | None, new: SliderNetwork | None) -> tuple[str, ...]:
    """Author on the face prim the network where it differs, or hide the one that is gone; a line for it."""
    if same(old, new):
        return ()
    if new is not None:
        author_slider_network(prim, new)
        return ("slider network",)
    for attribute in prim.GetAuthoredPropertiesInNamespace(_PREFIX):
        put(attribute, None)
    remove_schema(prim, tokens.SLIDER_NETWORK_API)
    return ("slider network removed",)
