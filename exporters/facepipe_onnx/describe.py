"""The metadata of a graph: face, joints, meshes, sliders, inputs and outputs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from facepipe.core import __version__
from facepipe.parts import FaceParts, Slider, SliderNetwork
from facepipe.records import Json
from facepipe.rig import CHANNELS, Rig
from facepipe.rig.rig import curves
from facepipe_onnx.graph import signature
from facepipe_onnx.metadata import DEFORMER, FURTHER, SLIDERS
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
_MARKS = 64  # points of a mesh
_MOST_ENTRIES = 8192
_ENTRIES = ("channel_curves", "channels", "shape_curves", "shapes")
_SLIDER_CONVENTIONS = {
    "sliders": "clamped to their ranges; what each adds to channels and shapes is gain * (value - default), or "
    "gain * curve(value) where it has a curve: knots (value, amount), straight between them, constant beyond; a "
    "slider_network, whose weights the graph holds, adds to channels and shapes from the clamped values of its sliders"
    f"; channels and shapes of more than {_MOST_ENTRIES:,} entries in all are null: the graph holds them too",
    "weights": "shape weights of expressions, added to those that sliders drive; 0 adds nothing",
    "skinning_matrices": "world times inverse bind: from skeleton space at bind time to world; blend by skin weights. "
    "For vertices of the face's GLB: gltf_from_world @ skinning matrix @ skeleton_from_gltf",
    "morph_weights": "activations of the morph targets, inbetweens among them; meshes[i].targets numbers those of a "
    "mesh in the order of its GLB targets",
}


def describe(
    parts: FaceParts,
    rig: Rig,
    options: Options,
    operators: list[str],
    sliders: Sequence[Slider] | None = None,
    network: SliderNetwork | None = None,
) -> Json:
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
            "outputs": [_output(name, shape, parts, rig) for name, shape in outputs.items()],
            "sliders": _slider_records(parts.sliders),
        }
    inputs, outputs = slider_signature(rig, sliders, options)
    (name, shape), *others = inputs.items()
    first = {  # ``default`` is the neutral, ``values`` what is set on the face
        "default": [slider.default for slider in sliders],
        "groups": [slider.group for slider in sliders],
        "name": name,
        "names": [slider.name for slider in sliders],
        "range": [[slider.minimum, slider.maximum] for slider in sliders],
        "shape": list(shape),
        "type": "float32",
        "values": [slider.setting for slider in sliders],
    }
    return metadata | {
        "conventions": _CONVENTIONS | _SLIDER_CONVENTIONS,
        "format": SLIDERS.format,
        "inputs": [first, *(_input(name, shape, parts, rig) for name, shape in others)],
        "meshes": _with_targets(metadata["meshes"], parts, rig),
        "outputs": [_output(name, shape, parts, rig) for name, shape in outputs.items()],
        "slider_network": None if network is None else network.summary(),
        "sliders": _slider_records(sliders),
    }


def _common(parts: FaceParts, rig: Rig, operators: list[str]) -> Json:
    # in world space: the skeleton's place may turn and scale what the meshes hold
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
        "inbetweens": [
            {
                "activation": _numbers(np.array(target.curve.knots)),
                "name": target.name,
                "shape": rig.shapes[target.shape],
            }
            for target in rig.targets
            if not target.curve.is_identity
        ],
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


def _input(name: str, shape: tuple[int, ...], parts: FaceParts, rig: Rig) -> Json:
    value: Json = {"name": name, "shape": list(shape), "type": "float32"}
    if name == "weights":
        return value | {"default": 0.0, "names": list(rig.shapes), "range": [0.0, 1.0]}
    if name == "coefficients":
        limits = parts.bone_limits
        return value | {
            "channels": list(CHANNELS),
            "default": [0.0] * 6 + [1.0] * 3,
            "joints": list(rig.joints),
            "limits": None if limits is None else {"lower": _numbers(limits.lower), "upper": _numbers(limits.upper)},
            "units": _units(),
        }
    if name == "joint_transforms":
        return value | {"default": _numbers(rig.rest), "joints": list(rig.joints), "space": "local to the parent joint"}
    return value | {"default": _numbers(rig.parent_world), "space": "world matrix that root joints hang under"}


def _output(name: str, shape: tuple[int, ...], parts: FaceParts, rig: Rig) -> Json:
    value: Json = {"name": name, "shape": list(shape), "type": "float32"}
    if name == "joint_matrices":
        return value | {"joints": list(rig.joints), "space": "world"}
    if name == "coefficients":
        return value | {"channels": list(CHANNELS), "joints": list(rig.joints), "units": _units()}
    if name == "skinning_matrices":
        world = parts.gltf_axes
        back = np.linalg.inv(world @ rig.parent_world)
        return value | {
            "gltf_from_world": _numbers(world),
            "joints": list(rig.joints),
            "skeleton_from_gltf": _numbers(back),
            "space": "skeleton space at bind time -> world, stage units",
        }
    if name == "morph_weights":
        targets = [{"name": target.name, "shape": rig.shapes[target.shape]} for target in rig.targets]
        return value | {"targets": targets}
    return value | {"space": "world", "units": "stage units" if name == "points" else "unit vectors, area-weighted"}


def _slider_records(sliders: Sequence[Slider]) -> list[Json]:
    """The sliders of the face; very many channels and shapes are in the graph alone."""
    short = sum(len(slider.channels) + len(slider.shapes) for slider in sliders) > _MOST_ENTRIES
    return [
        {
            "channel_curves": _curves(slider.channel_curves),
            "channels": [list(channel) for channel in slider.channels],
            "default": slider.default,
            "group": slider.group,
            "mirror": slider.mirror,
            "name": slider.name,
            "range": [slider.minimum, slider.maximum],
            "shape_curves": _curves(slider.shape_curves),
            "shapes": [list(shape) for shape in slider.shapes],
            "value": slider.setting,
            **(dict.fromkeys(_ENTRIES) if short else {}),
        }
        for slider in sliders
    ]


def _curves(found: Sequence[Any]) -> list[Any]:
    return [None if curve is None else [list(knot) for knot in curve] for curve in found]


def _units() -> list[str]:
    """Of the 9 bone coefficients of a joint."""
    return ["stage units"] * 3 + ["radians"] * 3 + ["factor of rest"] * 3


def _with_targets(meshes: Sequence[Json], parts: FaceParts, rig: Rig) -> list[Json]:
    """The `meshes` with the numbers of their morph targets, and with marks of their neutral."""
    neutral = rig.evaluate() @ parts.gltf_axes[:3, :3].T
    numbered = {(rig.shapes[target.shape], target.name, target.curve): i for i, target in enumerate(rig.targets)}
    described = []
    for entry, mesh in zip(meshes, parts.meshes, strict=True):
        points = neutral[entry["first"] :][: entry["count"]]
        # some points, evenly among all: by these, faces of one topology differ
        chosen = np.unique(np.linspace(0, len(points) - 1, min(_MARKS, len(points))).astype(int))
        rounded = [[float(f"{value:.6g}") + 0.0 for value in points[number]] for number in chosen]
        targets = []  # numbers in `Rig.targets` of its shapes, each followed by its inbetweens
        for shape in mesh.blendshapes:
            by_weight = curves(tuple(inbetween.weight for inbetween in shape.inbetweens))
            keys = [(shape.name, name, by_weight[weight]) for name, weight, _ in shape.sculpts]
            targets += [numbered[key] for key in keys if key in numbered]
        marks = {"points": chosen.tolist(), "positions": rounded}
        described.append(entry | {"marks": marks, "targets": targets})
    return described


def _numbers(values: Any) -> Any:
    """An array as JSON."""
    return np.asarray(values, dtype=np.float64).tolist()
