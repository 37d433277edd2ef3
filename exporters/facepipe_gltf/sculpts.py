"""Blendshapes and their inbetweens as morph targets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import ExportError
from facepipe.core.names import select
from facepipe.parts import Blendshape, FaceParts, Mesh, exact

Json = dict[str, Any]
Knots = tuple[tuple[float, float], ...]
_LINEAR: dict[float, Knots] = {1.0: ((0.0, 0.0), (1.0, 1.0))}


@dataclass(frozen=True)
class Sculpt:
    """One morph target of a mesh: a shape, or one of its inbetweens."""

    name: str
    label: str  # in the file; several may share one
    shape: str
    weight: float  # shape weight at which it is fully active
    knots: Knots  # activation over the shape's weight, piecewise linear, its ends extended
    is_inbetween: bool
    point_indices: IntArray
    offsets: FloatArray
    normal_offsets: FloatArray | None


def chosen_shapes(parts: FaceParts, globs: str) -> tuple[str, ...]:
    """Names of the face's shapes that match one of the comma-separated globs, in stage order.

    :raises InputError: a glob that matches none
    """
    names = list(dict.fromkeys(shape.name for mesh in parts.meshes for shape in mesh.blendshapes))
    return select(names, globs, "shapes")


def sculpts_of(mesh: Mesh, shapes: Sequence[str]) -> list[Sculpt]:
    """The morph targets of a mesh: its shapes in stage order, each followed by its inbetweens."""
    sculpts = [sculpt for shape in mesh.blendshapes if shape.name in shapes for sculpt in _expand(mesh, shape)]
    taken: set[str] = set()
    for sculpt in sculpts:
        if sculpt.name in taken:
            raise ExportError(f"{mesh.name} -> {sculpt.name}", "two morph targets of this name, expected one")
        taken.add(sculpt.name)
    return sculpts


def extras(sculpts: Sequence[Sculpt]) -> Json:
    """What an engine needs to drive inbetweens: which shape and weight each stands for, and activation curves."""
    inbetweens = {one.name: {"shape": one.shape, "weight": one.weight} for one in sculpts if one.is_inbetween}
    curves = {one.name: [list(knot) for knot in one.knots] for one in sculpts if len(one.knots) > 2}
    return {"inbetweens": inbetweens, "curves": curves} if inbetweens else {}


def _expand(mesh: Mesh, shape: Blendshape) -> list[Sculpt]:
    weights = [one.weight for one in shape.inbetweens]
    if weights and len({0.0, 1.0, *weights}) != len(weights) + 2:
        raise ExportError(
            f"{mesh.name} -> {shape.name}", f"inbetween weights {weights}, expected distinct ones, no 0 or 1"
        )
    knots = _knots(weights)
    main = Sculpt(
        name=shape.name,
        label=shape.name if weights else exact(shape),  # inbetweens name their shape
        shape=shape.name,
        weight=1.0,
        knots=knots[1.0],
        is_inbetween=False,
        point_indices=shape.point_indices,
        offsets=shape.offsets,
        normal_offsets=shape.normal_offsets,
    )
    return [main] + [
        Sculpt(
            name=f"{shape.name}_{one.name}",
            label=f"{shape.name}_{one.name}",
            shape=shape.name,
            weight=one.weight,
            knots=knots[one.weight],
            is_inbetween=True,
            point_indices=shape.point_indices,
            offsets=one.offsets,
            normal_offsets=one.normal_offsets,
        )
        for one in shape.inbetweens
    ]


def _knots(weights: Sequence[float]) -> dict[float, Knots]:
    if not weights:
        return _LINEAR
    from facepipe.rig.activation import curves

    return {weight: curve.knots for weight, curve in curves(tuple(weights)).items()}
