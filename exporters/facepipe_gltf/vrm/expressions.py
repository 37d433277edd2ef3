"""VRM's expressions: presets that the face has, or made of its ARKit shapes by a table; every shape by its name."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.names import first_names
from facepipe.parts import Blendshape, FaceParts
from facepipe.records import Json
from facepipe.rig import Rig, build, slide
from facepipe.rig.conventions import ARKIT_SHAPES, match_shapes, shapes_of
from facepipe_gltf.placement import place, space_of

_TABLE = Path(__file__).with_name("expressions.toml")
_STRAIGHT = [[0.0, 0.0], [1.0, 1.0]]
_STILL = 1e-6  # of the head height: offsets below are rounding
_LISTED = 3


@cache
def table() -> Mapping[str, Any]:
    """The table: ``preset``, name -> ARKit shape -> weight, and ``degrees``, kind -> direction -> angle."""
    read = tomllib.loads(_TABLE.read_text(encoding="utf-8"))
    for name, weights in read["preset"].items():
        read["preset"][name] = {
            f"{shape}{side}": weight
            for shape, weight in weights.items()
            for side in ([""] if shape in ARKIT_SHAPES else ["Left", "Right"])
        }
    return read


@dataclass(frozen=True)
class Target:
    """A morph target of a node, and how far it is on over the weight of its shape."""

    node: int
    index: int
    knots: Sequence[Sequence[float]]  # piecewise linear

    def bind(self, weight: float) -> Json | None:
        """A morphTargetBind at a weight of the shape; None where the target is off."""
        at, on = np.array(self.knots, np.float64).T
        value = round(float(np.interp(weight, at, on)), 6)
        return {"node": self.node, "index": self.index, "weight": value} if value else None


@dataclass(frozen=True)
class Expressions:
    """`VRMC_vrm.expressions`, and lines on presets and shapes that it leaves out."""

    json: Json
    lost: tuple[str, ...]

    def has(self, *presets: str) -> bool:
        """Whether each of these presets moves something."""
        return all(self.json["preset"].get(name, {}).get("morphTargetBinds") for name in presets)


def expressions_of(nodes: Sequence[Json], meshes: Sequence[Json]) -> Expressions:
    """The expressions of the morph targets that the meshes of a document name in their extras."""
    targets: dict[str, list[Target]] = {}
    by_mesh: list[list[str]] = []
    for i, node in enumerate(nodes):
        extras = meshes[node["mesh"]].get("extras", {}) if "mesh" in node else {}
        ours = extras.get("facepipe", {})
        by_mesh.append([])
        for index, name in enumerate(extras.get("targetNames", [])):
            shape = ours.get("inbetweens", {}).get(name, {}).get("shape", name)
            knots = ours.get("curves", {}).get(name, _STRAIGHT)
            targets.setdefault(shape, []).append(Target(i, index, knots))
            by_mesh[-1].append(shape)
    presets = table()["preset"]
    shapes = [*targets]
    named, arkit = match_shapes(presets, shapes, by_mesh), match_shapes(sorted(ARKIT_SHAPES), shapes, by_mesh)
    preset: Json = {}
    lost: list[str] = []
    for name, weights in presets.items():
        sculpted = named.get(name, ())
        # a preset that was sculpted is whole: the table's mixture on top would move points twice
        made = {} if sculpted else {one: weight for shape, weight in weights.items() for one in arkit.get(shape, ())}
        if sculpted or made or not weights:
            preset[name] = _expression(dict.fromkeys(sculpted, 1.0) | made, targets)
        lacking = [] if sculpted else [shape for shape in weights if shape not in arkit]
        if made and lacking:
            lost.append(f"part of the expression {name} (no shape {', '.join(lacking)})")
    absent = [name for name in presets if name not in preset]
    if absent:
        lost.append(f"the expressions {', '.join(absent)} (no shape of the face belongs to them)")
    custom = {shape: _expression({shape: 1.0}, targets) for shape in targets if shape not in presets}
    curved = [shape for shape, every in targets.items() if any(len(one.knots) > 2 for one in every)]
    if curved:
        lost.append(f"inbetweens ({len(curved)} shapes: {first_names(curved, 3)}): VRM's expressions are linear")
    return Expressions({"preset": preset} | ({"custom": custom} if custom else {}), tuple(lost))


def _expression(weights: Mapping[str, float], targets: Mapping[str, Sequence[Target]]) -> Json:
    binds = [one.bind(weight) for shape, weight in weights.items() for one in targets[shape]]
    found = sorted((bind for bind in binds if bind is not None), key=lambda one: (one["node"], one["index"]))
    return {"morphTargetBinds": found} if found else {}


def with_slider_shapes(parts: FaceParts) -> tuple[FaceParts, tuple[str, ...]]:
    """The face with a shape for each slider named like a missing ARKit shape, and a line on these for the report.

    A shape is what its slider does at its largest value, from the face as it is set.
    """
    shapes = list(parts.shapes)
    there = match_shapes(sorted(ARKIT_SHAPES), shapes, shapes_of(parts.meshes))
    lacking = [name for name in sorted(ARKIT_SHAPES) if name not in there]
    sliders_by_shape = match_shapes(lacking, [slider.name for slider in parts.sliders])
    if not sliders_by_shape:
        return parts, ()
    rig, space = build(parts), space_of(parts)
    by_name = {slider.name: slider for slider in parts.sliders}
    rest = _points(parts, rig, {})
    still = _STILL * float(np.ptp(rest, axis=0).max())
    made: dict[str, list[Blendshape]] = {mesh.name: [] for mesh in parts.meshes}
    names, worst = [], 0.0
    for name, sliders in sliders_by_shape.items():
        full = _points(parts, rig, {one: by_name[one].maximum for one in sliders}) - rest
        # curves and turns of joints bend, an expression is straight: half way it is off by |half - full / 2|
        halfway = {one: (by_name[one].maximum + by_name[one].setting) / 2 for one in sliders}
        half = _points(parts, rig, halfway) - rest
        if np.abs(full).max() > still:
            names.append(name)
            worst = max(worst, float(np.linalg.norm(half - full / 2, axis=1).max()))
        for mesh, offsets in zip(parts.meshes, rig.split(full).values(), strict=True):
            moving = np.flatnonzero(np.abs(offsets).max(axis=1) > still)
            if len(moving):
                # (n, 3) world offsets of a mesh's points, as offsets of its own points before they are skinned at rest
                matrices = place(mesh, parts.skeleton, space, skinned=False).matrices[:, :3, :3]
                local = np.einsum("nij,nj->ni", np.linalg.inv(matrices) @ space.world[:3, :3], offsets)[moving]
                made[mesh.name].append(Blendshape(name=name, point_indices=moving.astype(np.int32), offsets=local))
    meshes = tuple(replace(mesh, blendshapes=(*mesh.blendshapes, *made[mesh.name])) for mesh in parts.meshes)
    off = worst * parts.meters_per_unit * 1000
    count = f"{len(names)} shape{'s' * (len(names) > 1)}"
    line = f"{count} that sliders make ({first_names(names, _LISTED)})"
    summary = (f"{line}: exact at full value, off by at most {off:.2g} mm half way",) if names else ()
    return replace(parts, meshes=meshes), summary


def _points(parts: FaceParts, rig: Rig, values: Mapping[str, float]) -> FloatArray:
    """(n, 3) points of the face with these sliders moved."""
    coefficients, weights = slide(parts.sliders, parts.skeleton.joints, values, parts.slider_network)
    return rig.evaluate(weights, coefficients=coefficients)
