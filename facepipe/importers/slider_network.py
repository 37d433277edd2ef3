"""A learned network of sliders out of an .npz file, as training code saves it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from facepipe.core.errors import InputError
from facepipe.core.reading import check_regular
from facepipe.importers.npz import Field, array_names, read_arrays
from facepipe.parts import SliderNetwork
from facepipe.rig import CHANNELS
from facepipe.rig.sliders import network_fault

MOST_BYTES = 1 << 28
MOST_LAYERS = 32
_SHAPE = "shape:"


def read_network(path: Path, joints: Sequence[str], shapes: Sequence[str]) -> SliderNetwork:
    """The network in a file, for a face of these joints and shapes.

    Arrays: ``sliders`` and ``outputs``, texts; ``layer0.weight`` (out, in), ``layer0.bias`` (out,) and so on, as a
    state of ``torch.nn.Linear`` layers holds them; by choice ``activation``, a text, and ``info``, a JSON object. An
    output is ``joint:channel``, with the path of a joint or its last name, or ``shape:name``.

    :raises InputError: not readable, damaged, or outputs that the face lacks
    """
    fields = {"sliders": Field("str", ("inputs",)), "outputs": Field("str", ("outputs",))}
    check_regular(path, MOST_BYTES)
    names = array_names(path)
    fields |= {name: Field("str", ()) for name in ("activation", "info") if name in names}
    layers = 0
    while f"layer{layers}.weight" in names and layers <= MOST_LAYERS:
        before = "inputs" if layers == 0 else f"units{layers - 1}"
        fields[f"layer{layers}.weight"] = Field("float", (f"units{layers}", before))
        fields[f"layer{layers}.bias"] = Field("float", (f"units{layers}",))
        layers += 1
    extra = sorted(names - set(fields))
    if not 0 < layers <= MOST_LAYERS or extra:
        excess = f"array '{extra[0][:60]}'" if extra else f"{layers} layers"
        expected = (
            f"sliders, outputs, activation, info, layer0.weight, layer0.bias and so on, up to {MOST_LAYERS} layers"
        )
        raise InputError(path, f"{excess}, expected {expected}")
    arrays = read_arrays(path, fields, {})
    outputs = [str(one) for one in arrays["outputs"]]
    found = [_output(path, output, joints, shapes) for output in outputs]
    order = [i for i, one in enumerate(found) if isinstance(one, tuple)]
    order += [i for i, one in enumerate(found) if not isinstance(one, tuple)]  # shapes come after bones
    weights, biases = ([arrays[f"layer{i}.{kind}"] for i in range(layers)] for kind in ("weight", "bias"))
    if weights[-1].shape[0] != len(outputs) or biases[-1].shape != (len(outputs),):
        raise InputError(
            path, f"{weights[-1].shape[0]} rows in the last layer, expected one for each of {len(outputs)}"
        )
    try:
        info = json.loads(str(arrays["info"]), parse_constant=lambda word: None) if "info" in arrays else {}
    except (ValueError, RecursionError):
        info = None
    if not isinstance(info, dict):
        raise InputError(f"{path} -> info", "no JSON object, expected one")
    network = SliderNetwork(
        sliders=tuple(str(one) for one in arrays["sliders"]),
        channels=tuple(one for one in found if isinstance(one, tuple)),
        shapes=tuple(one for one in found if isinstance(one, str)),
        weights=(*(weight.astype(np.float32) for weight in weights[:-1]), weights[-1][order].astype(np.float32)),
        biases=(*(biase.astype(np.float32) for biase in biases[:-1]), biases[-1][order].astype(np.float32)),
        activation=str(arrays["activation"]) if "activation" in arrays else "tanh",  # type: ignore[arg-type]
        info=info,
    )
    fault = network_fault(network)
    if fault:
        raise InputError(path, fault)
    return network


def _output(path: Path, name: str, joints: Sequence[str], shapes: Sequence[str]) -> tuple[str, str] | str:
    where = f"{path} -> outputs -> {name[:80]}"
    if name.startswith(_SHAPE):
        shape = name.removeprefix(_SHAPE)
        if shape not in shapes:
            raise InputError(where, f"no shape '{shape[:60]}' on the face")
        return shape
    joint, _, channel = name.rpartition(":")
    matches = [one for one in joints if joint in (one, one.rpartition("/")[2])]
    if len(matches) != 1 or channel not in CHANNELS:
        raise InputError(
            where, "expected JOINT:CHANNEL, of a joint of the face and one of its 9 channels, or shape:NAME"
        )
    return matches[0], channel
