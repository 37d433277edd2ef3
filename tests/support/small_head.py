"""The head of the package in few triangles: what unit tests need a whole face for.

Shapes, joints, skin, sliders over bones, regions and landmarks are the head's own, at the points that stay.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
from shared_lids import with_shared_lids

from facepipe import heads
from facepipe.core.arrays import IntArray
from facepipe.parts import FaceParts, Mesh
from facepipe.rig import build
from facepipe.verbs.lod.decimate import Surface, Wedges, mesh_of, wedges_of

_TRIANGLES, _SKIN_SHARE = 6000, 0.6


def make(seed: int = 0, *, textures: int = 0) -> FaceParts:
    """A person's head, in centimetres; seed 0 is the average one. One topology for all.

    :param textures: texels a side of the skin's textures; 0: colours at points
    """
    parts = heads.make(seed, textures=textures, controls="bones")
    kept = zip(parts.meshes, _level(), strict=False)  # without cards of hairs, which come with textures
    meshes = tuple(_moving(mesh_of(replace(wedges, mesh=mesh), triangles)) for mesh, (wedges, triangles) in kept)
    worn = {material_face.material for mesh in meshes for material_face in mesh.material_faces}
    materials = tuple(material for material in parts.materials if material.name in worn)
    sliders = tuple(slider for slider in parts.sliders if slider.name != "headSize")  # photos have no scale
    return replace(parts, meshes=meshes, materials=materials, sliders=sliders)


def lean(parts: FaceParts, *shapes: str) -> FaceParts:
    """The face with these shapes alone, and the sliders that need no other; without animations."""
    meshes = tuple(
        replace(mesh, blendshapes=tuple(blendshape for blendshape in mesh.blendshapes if blendshape.name in shapes))
        for mesh in parts.meshes
    )
    sliders = tuple(slider for slider in parts.sliders if {name for name, _ in slider.shapes} <= {*shapes})
    return replace(parts, meshes=meshes, sliders=sliders, animations=())


def _moving(mesh: Mesh) -> Mesh:
    """Without shapes that move none of its points."""
    return replace(
        mesh, blendshapes=tuple(blendshape for blendshape in mesh.blendshapes if len(blendshape.point_indices))
    )


@cache
def _level() -> Sequence[tuple[Wedges, IntArray]]:
    """Each mesh of the average head in wedges, and those of them (t, 3) that make the triangles that stay.

    Lids are decimated as all people would share them: those of one person differ in the last digits from machine to
    machine, and other triangles follow.
    """
    parts = with_shared_lids(heads.make(controls="bones"))
    surface = Surface(parts, build(parts))
    level = surface.level(_TRIANGLES, _SKIN_SHARE, surface.full)
    wedges = [wedges_of(mesh) for mesh in parts.meshes]
    starts = np.cumsum([0, *(len(wedge.points) for wedge in wedges)])
    mesh = np.searchsorted(starts, level[:, 0], side="right") - 1
    return [(one, level[mesh == i] - starts[i]) for i, one in enumerate(wedges)]
