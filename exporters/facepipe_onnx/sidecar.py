"""What a graph means, as JSON: in the model's metadata and, the same, in a file beside it.

Top-level keys are stored as `metadata_props` ``facepipe.<key>``; the sidecar ``<model file>.json`` is an object of
them.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from facepipe import __version__
from facepipe.errors import InputError
from facepipe.parts import FaceParts
from facepipe.rig import CHANNELS, Rig
from facepipe_onnx.graph import signature
from facepipe_onnx.operators import FURTHER
from facepipe_onnx.options import Options

PREFIX = "facepipe."
FORMAT = {"name": "facepipe deformer", "version": 1}
REQUIRED = ("conventions", "face", "format", "inputs", "meshes", "operators", "outputs")

_CONVENTIONS = {
    "angles": "radians",
    "lengths": "stage units; times face.meters_per_unit = metres",
    "space": "world space of the stage, right-handed, up axis face.up_axis",
    "matrices": "for column vectors, stored row by row: the translation is the last column",
    "coefficients": "M = T(t) Rz(rz) Rx(rx) Ry(ry) S(s); local = rest M; world = world_parent local",
    "order": "blendshapes first, then linear blend skinning",
    "weights": "0 neutral, 1 the sculpt; other weights extrapolate, inbetweens interpolate piecewise linearly",
}


def path_of(model: Path) -> Path:
    """The sidecar of a model file."""
    return model.with_name(f"{model.name}.json")


def describe(parts: FaceParts, rig: Rig, options: Options, operators: list[str]) -> dict[str, Any]:
    """The metadata of a graph.

    :param rig: the rig with the exported shapes only
    :param operators: the operators of the graph, sorted
    """
    inputs, outputs = signature(rig, options)
    neutral = rig.evaluate()
    return {
        "conventions": _CONVENTIONS,
        "face": {
            "attach_joint": parts.attach_joint,
            "attribution": parts.attribution,
            "head_height": float(np.ptp(neutral[:, 2 if parts.up_axis == "Z" else 1])),
            "meters_per_unit": parts.meters_per_unit,
            "name": parts.name,
            "up_axis": parts.up_axis,
        },
        "format": FORMAT,
        "further_operators": [name for name in operators if name in FURTHER],
        "generator": f"facepipe {__version__}",
        "inbetweens": [_sculpt(rig, i) for i, target in enumerate(rig.targets) if not target.curve.is_identity],
        "inputs": [_input(name, shape, parts, rig) for name, shape in inputs.items()],
        "joints": [
            {"path": joint, "parent": int(parent)} for joint, parent in zip(rig.joints, rig.parents, strict=True)
        ],
        "meshes": [
            {
                "name": name,
                "first": int(rig.mesh_offsets[i]),
                "count": int(rig.mesh_offsets[i + 1] - rig.mesh_offsets[i]),
            }
            for i, name in enumerate(rig.mesh_names)
        ],
        "operators": operators,
        "outputs": [_output(name, shape, rig) for name, shape in outputs.items()],
        "sliders": [_slider(parts, i) for i in range(len(parts.sliders))],
    }


def _input(name: str, shape: tuple[int, ...], parts: FaceParts, rig: Rig) -> dict[str, Any]:
    own: dict[str, Any] = {"name": name, "shape": list(shape), "type": "float32"}
    if name == "weights":
        return own | {"default": 0.0, "names": list(rig.shapes), "range": [0.0, 1.0]}
    if name == "coefficients":
        limits = parts.bone_limits
        return own | {
            "channels": list(CHANNELS),
            "default": [0.0] * 6 + [1.0] * 3,
            "joints": list(rig.joints),
            "limits": None if limits is None else {"lower": _numbers(limits.lower), "upper": _numbers(limits.upper)},
            "units": ["stage units"] * 3 + ["radians"] * 3 + ["factor of rest"] * 3,
        }
    if name == "joint_transforms":
        return own | {"default": _numbers(rig.rest), "joints": list(rig.joints), "space": "local to the parent joint"}
    return own | {"default": _numbers(rig.parent_world), "space": "world matrix that root joints hang under"}


def _output(name: str, shape: tuple[int, ...], rig: Rig) -> dict[str, Any]:
    own: dict[str, Any] = {"name": name, "shape": list(shape), "type": "float32"}
    if name == "joint_matrices":
        return own | {"joints": list(rig.joints), "space": "world"}
    return own | {"space": "world", "units": "stage units" if name == "points" else "unit vectors, area-weighted"}


def _sculpt(rig: Rig, number: int) -> dict[str, Any]:
    target = rig.targets[number]
    return {
        "name": target.name,
        "shape": rig.shapes[target.shape],
        "activation": _numbers(np.array(target.curve.knots)),
    }


def _slider(parts: FaceParts, number: int) -> dict[str, Any]:
    slider = parts.sliders[number]
    return {
        "channels": [list(channel) for channel in slider.channels],
        "default": slider.default,
        "group": slider.group,
        "name": slider.name,
        "range": [slider.minimum, slider.maximum],
        "shapes": [list(shape) for shape in slider.shapes],
    }


def _numbers(values: Any) -> Any:
    return np.asarray(values, dtype=np.float64).tolist()


def to_properties(metadata: dict[str, Any]) -> dict[str, str]:
    """Metadata as `metadata_props`."""
    return {PREFIX + key: json.dumps(metadata[key], sort_keys=True, allow_nan=False) for key in sorted(metadata)}


def from_properties(properties: dict[str, str]) -> dict[str, Any]:
    """Metadata out of `metadata_props`; keys of others are left out.

    :raises InputError: text that is no JSON
    """
    own = {key.removeprefix(PREFIX): text for key, text in properties.items() if key.startswith(PREFIX)}
    return {key: parse(text, f"metadata {PREFIX}{key}") for key, text in own.items()}


def to_text(metadata: dict[str, Any]) -> str:
    """Metadata as the sidecar's text."""
    return json.dumps(metadata, sort_keys=True, indent=1, allow_nan=False) + "\n"


def parse(text: str | bytes, where: object) -> Any:
    """JSON without NaN and infinity.

    :raises InputError: it is not that
    """

    def refuse(word: str) -> Any:
        raise ValueError(f"number {word}")

    try:
        return json.loads(text, parse_constant=refuse)
    except (ValueError, RecursionError) as error:
        raise InputError(where, f"no valid JSON ({error})") from error
