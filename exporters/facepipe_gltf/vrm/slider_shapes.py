"""Shapes made of sliders: VRM's expressions move shapes alone, and some faces make ARKit's shapes with joints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.parts import Blendshape, FaceParts, Mesh, Slider
from facepipe.rig import Rig, build, slide
from facepipe.rig.conventions import ARKIT_SHAPES, match_shapes
from facepipe_gltf.placement import Space, place, space_of

_STILL = 1e-6  # of the head height: offsets below are rounding
_LISTED = 3


def with_slider_shapes(parts: FaceParts) -> tuple[FaceParts, tuple[str, ...]]:
    """The face with a shape for each slider called as one of ARKit's shapes that it lacks, and what to say of them.

    A shape is what its slider does at its largest value, from the face as it is set.
    """
    shapes = list(dict.fromkeys(shape.name for mesh in parts.meshes for shape in mesh.blendshapes))
    there = match_shapes(sorted(ARKIT_SHAPES), shapes)
    lacking = [name for name in sorted(ARKIT_SHAPES) if name not in there]
    found = match_shapes(lacking, [slider.name for slider in parts.sliders])
    if not found:
        return parts, ()
    rig, space = build(parts), space_of(parts)
    own = {slider.name: slider for slider in parts.sliders}
    rest = _points(parts, rig, {})
    still = _STILL * float(np.ptp(rest, axis=0).max())
    made: dict[str, list[Blendshape]] = {mesh.name: [] for mesh in parts.meshes}
    names, worst = [], 0.0
    for name, sliders in found.items():
        full = _points(parts, rig, {one: own[one].maximum for one in sliders}) - rest
        half = _points(parts, rig, {one: (own[one].maximum + _authored(own[one])) / 2 for one in sliders}) - rest
        if np.abs(full).max() > still:
            names.append(name)
            worst = max(worst, float(np.linalg.norm(half - full / 2, axis=1).max()))
        for mesh, offsets in zip(parts.meshes, rig.split(full).values(), strict=True):
            moving = np.flatnonzero(np.abs(offsets).max(axis=1) > still)
            if len(moving):
                local = _in_mesh(parts, mesh, space, offsets)[moving]
                made[mesh.name].append(Blendshape(name=name, point_indices=moving.astype(np.int32), offsets=local))
    meshes = tuple(replace(mesh, blendshapes=(*mesh.blendshapes, *made[mesh.name])) for mesh in parts.meshes)
    return replace(parts, meshes=meshes), _said(names, worst * parts.meters_per_unit * 1000)


def _said(names: Sequence[str], off: float) -> tuple[str, ...]:
    """What the report says of the shapes."""
    if not names:
        return ()
    some = ", ".join(names[:_LISTED]) + (" ..." if len(names) > _LISTED else "")
    count = f"{len(names)} shape{'s' * (len(names) > 1)}"
    return (f"{count} that sliders make ({some}): alike at full value, half way at most {off:.2g} mm off",)


def _points(parts: FaceParts, rig: Rig, values: Mapping[str, float]) -> FloatArray:
    """(n, 3) points of the face with these sliders moved."""
    coefficients, weights = slide(parts.sliders, parts.skeleton.joints, values, parts.slider_network)
    return rig.evaluate(weights, coefficients=coefficients)


def _authored(slider: Slider) -> float:
    return slider.default if slider.value is None else slider.value


def _in_mesh(parts: FaceParts, mesh: Mesh, space: Space, offsets: FloatArray) -> FloatArray:
    """(n, 3) world offsets of a mesh's points, as offsets of its own points before they are skinned at rest."""
    matrices = place(mesh, parts.skeleton, space, skinned=False).matrices[:, :3, :3]
    return np.asarray(np.einsum("nij,nj->ni", np.linalg.inv(matrices) @ space.world[:3, :3], offsets))
