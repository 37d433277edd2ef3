"""The sample's meshes in their neutral pose, without skin and shapes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.polygons import point_normals, point_triangles
from facepipe.parts import MaterialFaces, Mesh
from procedural_head import colors, eyeballs, eyes, head, scalp, skull, strands, teeth, topology, uv
from procedural_head.identity import Identity
from procedural_head.solids import Solid


@dataclass(frozen=True)
class Neutral:
    """The neutral meshes, and what their skin and shapes hang on."""

    who: Identity
    head: Mesh
    eyeballs: tuple[Mesh, Mesh]  # left, right
    teeth: tuple[Mesh, Mesh]  # upper, lower
    tongue: Mesh
    brows: Mesh
    lashes: Mesh
    hair: Mesh
    brow_strips: strands.Brows
    lash_strips: strands.Lashes


def build(who: Identity) -> Neutral:
    """The neutral meshes of an identity."""
    points = head.points(who)
    top = topology.build()
    triangles = point_triangles(top.face_vertex_counts, top.face_vertex_indices)
    skin = Mesh(
        name="Head",
        points=points,
        face_vertex_counts=top.face_vertex_counts,
        face_vertex_indices=top.face_vertex_indices,
        normals=point_normals(points, triangles),
        uv_sets=(uv.head(),),
        colors=colors.head(points, who),
        material="Skin",
    )
    brow_strips, lash_strips = strands.brows(points, who), strands.lashes(points, who)
    shell = scalp.build(skull.build(who), who)
    upper, lower, tongue = teeth.row(who, upper=True), teeth.row(who, upper=False), teeth.tongue(who)
    return Neutral(
        who=who,
        head=skin,
        eyeballs=(_eyeball("EyeLeft", who, 1.0), _eyeball("EyeRight", who, -1.0)),
        teeth=(
            _grouped(_solid("TeethUpper", *upper, "Teeth"), teeth.face_groups(upper=True)),
            _grouped(_solid("TeethLower", *lower, "Teeth"), teeth.face_groups(upper=False)),
        ),
        tongue=_solid("Tongue", *tongue, "Tongue"),
        brows=_hairs("Brows", brow_strips.solid, strands.brow_colors(who), "Brows"),
        lashes=_hairs("Lashes", lash_strips.solid, np.tile(who.hair, (len(lash_strips.solid.points), 1)) * 0.6),
        hair=_hairs("Hair", shell, scalp.colors(who)),
        brow_strips=brow_strips,
        lash_strips=lash_strips,
    )


def _solid(name: str, solid: Solid, point_colors: FloatArray, material: str, *, double_sided: bool = False) -> Mesh:
    return Mesh(
        name=name,
        points=solid.points,
        face_vertex_counts=solid.counts,
        face_vertex_indices=solid.indices,
        normals=point_normals(solid.points, point_triangles(solid.counts, solid.indices)),
        uv_sets=(solid.uvs,),
        colors=point_colors,
        material=material,
        double_sided=double_sided,
    )


def _eyeball(name: str, who: Identity, side: float) -> Mesh:
    shape = eyes.eye(who)
    unit = eyeballs.unit()
    points = shape.center * (side, 1.0, 1.0) + shape.radius * unit.points
    solid = Solid(points, unit.counts, unit.indices, unit.uvs)
    mesh = _solid(name, solid, eyeballs.colors(who), "Sclera")
    return _grouped(mesh, eyeballs.face_groups())


def _grouped(mesh: Mesh, groups: Mapping[str, IntArray]) -> Mesh:
    """The mesh with a material on each group of faces."""
    return replace(
        mesh, material_faces=tuple(MaterialFaces(material=key, faces=faces) for key, faces in groups.items())
    )


def _hairs(name: str, solid: Solid, point_colors: FloatArray, material: str = "Hair") -> Mesh:
    return _solid(name, solid, point_colors, material, double_sided=True)
