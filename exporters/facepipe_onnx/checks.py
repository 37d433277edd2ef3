"""Numbers that must be finite before a face becomes a graph, so that errors name the face's part and not a tensor."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from facepipe.errors import ExportError
from facepipe.parts import FaceParts, Mesh


def require_finite(parts: FaceParts) -> None:
    """Check all numbers that the graph or its metadata hold.

    :raises ExportError: naming the first that is NaN or infinity
    """
    for where, values in _numbers(parts):
        if not np.isfinite(np.asarray(values, dtype=np.float64)).all():
            raise ExportError(f"{parts.name} -> {where}", "NaN or infinity, expected finite numbers")


def _numbers(parts: FaceParts) -> Iterator[tuple[str, Any]]:
    yield "metersPerUnit", parts.meters_per_unit
    skeleton = parts.skeleton
    yield f"{skeleton.name} -> transform", skeleton.transform
    yield f"{skeleton.name} -> bindTransforms", skeleton.bind_transforms
    yield f"{skeleton.name} -> restTransforms", skeleton.rest_transforms
    for mesh in parts.meshes:
        yield from _mesh_numbers(mesh)
    if parts.bone_limits is not None:
        yield f"{skeleton.name} -> bone limits -> lower", parts.bone_limits.lower
        yield f"{skeleton.name} -> bone limits -> upper", parts.bone_limits.upper
    for slider in parts.sliders:
        gains = [gain for *_, gain in (*slider.channels, *slider.shapes)]
        yield f"slider {slider.name}", [slider.default, slider.minimum, slider.maximum, *gains]


def _mesh_numbers(mesh: Mesh) -> Iterator[tuple[str, Any]]:
    yield f"{mesh.name} -> points", mesh.points
    yield f"{mesh.name} -> transform", mesh.transform
    if mesh.skin is not None:
        yield f"{mesh.name} -> jointWeights", mesh.skin.joint_weights
        yield f"{mesh.name} -> geomBindTransform", mesh.skin.geom_bind_transform
    for shape in mesh.blendshapes:
        yield f"{mesh.name} -> {shape.name} -> offsets", shape.offsets
        for one in shape.inbetweens:
            yield f"{mesh.name} -> {shape.name} -> {one.name} -> weight", one.weight
            yield f"{mesh.name} -> {shape.name} -> {one.name} -> offsets", one.offsets
