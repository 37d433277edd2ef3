"""What a graph means: the metadata of a face, its joints, meshes, sliders, inputs and outputs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from facepipe.core import __version__
from facepipe.parts import FaceParts, Slider, SliderNetwork
from facepipe.rig import CHANNELS, Rig
from facepipe_onnx import describe_sliders
from facepipe_onnx.describe_sliders import numbers, units
from facepipe_onnx.graph import signature
from facepipe_onnx.kinds import DEFORMER, SLIDERS
from facepipe_onnx.operators import FURTHER
from facepipe_onnx.options import Options
from facepipe_onnx.slider_graph import signature as slider_signature

_CONVENTIONS = {
    "angles": "radians",
    "lengths": "stage units; times face.meters_per_unit = metres",
    "space": "world space of the stage, right-handed, up axis face.up_axis",
    "matrices": "for column vectors, stored row by row: the translation is the last column",
    "coefficients": "M = T(t) Rz(rz) Rx(rx) Ry(ry) S(s); local = rest M; world = world_parent local",
    "order": "blendshapes first, then linear blend skinning",
    "weights": "0 neutral, 1 the sculpt; other weights extrapolate, inbetweens interpolate piecewise linearly",
}


def describe(
    parts: FaceParts,
    rig: Rig,
    options: Options,
    operators: list[str],
    sliders: Sequence[Slider] | None = None,
    network: SliderNetwork | None = None,
) -> dict[str, Any]:
    """The metadata of a graph.

    :param rig: the rig with the exported shapes only
    :param operators: the operators of the graph, sorted
    :param sliders: of a graph of sliders, with what they do to the exported shapes only
    :param network: of the sliders, likewise
    """
    metadata = _common(parts, rig, operators)
    if sliders is None:
        inputs, outputs = signature(rig, options)
        return metadata | {
            "conventions": _CONVENTIONS,
            "format": DEFORMER.format,
            "inputs": [_input(name, shape, parts, rig) for name, shape in inputs.items()],
            "outputs": [_output(name, shape, rig) for name, shape in outputs.items()],
            "sliders": describe_sliders.records(parts.sliders),
        }
    inputs, outputs = slider_signature(rig, sliders, options)
    first, *others = inputs.items()
    return metadata | {
        "conventions": _CONVENTIONS | describe_sliders.CONVENTIONS,
        "format": SLIDERS.format,
        "inputs": [
            describe_sliders.slider_input(*first, sliders),
            *(_input(name, shape, parts, rig) for name, shape in others),
        ],
        "meshes": describe_sliders.with_targets(metadata["meshes"], parts, rig),
        "outputs": [
            describe_sliders.output(name, shape, parts, rig) or _output(name, shape, rig)
            for name, shape in outputs.items()
        ],
        "slider_network": None if network is None else describe_sliders.network_record(network),
        "sliders": describe_sliders.records(sliders),
    }


def _common(parts: FaceParts, rig: Rig, operators: list[str]) -> dict[str, Any]:
    neutral = rig.evaluate()
    return {
        "face": {
            "attach_joint": parts.attach_joint,
            "attribution": parts.attribution,
            "head_height": float(np.ptp(neutral[:, 2 if parts.up_axis == "Z" else 1])) if len(neutral) else 0.0,
            "meters_per_unit": parts.meters_per_unit,
            "name": parts.name,
            "up_axis": parts.up_axis,
        },
        "further_operators": [name for name in operators if name in FURTHER],
        "generator": f"facepipe {__version__}",
        "inbetweens": [_sculpt(rig, i) for i, target in enumerate(rig.targets) if not target.curve.is_identity],
        "joints": [
            {"path": joint, "name": name, "parent": int(parent)}
            for joint, name, parent in zip(rig.joints, parts.skeleton.names, rig.parents, strict=True)
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
            "limits": None if limits is None else {"lower": numbers(limits.lower), "upper": numbers(limits.upper)},
            "units": units(),
        }
    if name == "joint_transforms":
        return own | {"default": numbers(rig.rest), "joints": list(rig.joints), "space": "local to the parent joint"}
    return own | {"default": numbers(rig.parent_world), "space": "world matrix that root joints hang under"}


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
        "activation": numbers(np.array(target.curve.knots)),
    }
