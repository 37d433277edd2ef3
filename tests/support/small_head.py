"""The head of the package in few triangles: what unit tests need a whole face for.

Shapes, joints, skin, sliders over bones, regions and landmarks are the head's own, at the points that stay.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from facepipe import heads
from facepipe.core.arrays import IntArray
from facepipe.parts import FaceParts, Mesh
from facepipe.verbs.lod.decimate import Wedges, mesh_of, wedges_of


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
    """Each mesh of the head in wedges, and those of them (t, 3) that make the triangles that stay.

    small_head.npz holds them, 6,000 as `facepipe lod` left them of the average head, six tenths of them skin. They are
    not decimated again: lips and lids are fitted, the last digits of fits differ from machine to machine and from one
    version to the next, and other triangles follow.
    """
    with np.load(Path(__file__).with_suffix(".npz")) as stored:
        level = stored["triangles"].astype(np.int64)
    wedges = [wedges_of(mesh) for mesh in heads.make(controls="bones").meshes]
    starts = np.cumsum([0, *(len(wedge.points) for wedge in wedges)])
    mesh = np.searchsorted(starts, level[:, 0], side="right") - 1
    return [(one, level[mesh == i] - starts[i]) for i, one in enumerate(wedges)]
