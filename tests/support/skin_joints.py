"""Joint sets placed by the landmarks of a face, for tests."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from faces import with_meshes
from import_data import shared
from small_head import make

from facepipe import heads
from facepipe.importers import ict, makehuman
from facepipe.parts import FaceParts, Mesh, Skeleton
from facepipe.stage import Face
from facepipe.verbs.skin import JointSet, JointSpec, SkinFace, SkinReport
from facepipe.verbs.skin.surface import eyeballs_of, surface_of

Array = np.ndarray[Any, Any]

# joint -> landmarks of multipie68 whose middle it stands at
ICT_KIND = pytest.param("ict", marks=pytest.mark.slow)  # the sample, which is made of it, is quicker
KINDS = ("sample", ICT_KIND, "makehuman")
_ICT = {"Teeth": ("head", "head/jaw"), "GumsAndTongue": ("head", "head/jaw")}
HELD = {  # loose parts that joints hold whole
    "sample": _ICT,
    "whole sample": _ICT,
    "ict": _ICT,
    "makehuman": {"TeethUpper": ("head", "head"), "TeethLower": ("head/jaw", "head/jaw"), "Tongue": ("head/jaw",) * 2},
}
AT = {
    "head/jaw/lipLower": (57, 66),
    "head/jaw/lipLowerRight": (58, 59),
    "head/jaw/lipLowerLeft": (55, 56),
    "head/lipUpper": (51, 62),
    "head/lipUpperRight": (49, 50),
    "head/lipUpperLeft": (52, 53),
    "head/lipCornerRight": (48,),
    "head/lipCornerLeft": (54,),
    "head/noseTip": (30,),
    "head/browRight": (19,),
    "head/browLeft": (24,),
    "head/lidUpperRight": (37, 38),
    "head/lidUpperLeft": (43, 44),
    "head/lidLowerRight": (40, 41),
    "head/lidLowerLeft": (46, 47),
}
RADII = {"lid": 18.0, "lipUpper": 30.0, "lipLower": 30.0, "lipCorner": 35.0, "nose": 45.0, "brow": 40.0}


def landmark_joints(face: Face, parts: dict[str, tuple[str, str]] | None = None) -> JointSet:
    """Lips, lids, brows, nose at the surface; jaw, eyes and head inside."""
    surface = surface_of(face.parts(), face.where)
    at = surface.points[surface.landmarks]
    right, left = at[0], at[16]
    brow, chin = at[21:23].mean(axis=0), at[8]
    ears = (right + left) / 2
    found = {"head": ears + 0.4 * (brow - chin), "head/jaw": ears}
    found |= {name: at[list(marks)].mean(axis=0) for name, marks in AT.items()}
    for ball in eyeballs_of(surface):
        found["head/eyeLeft" if ball.centre[0] > 0 else "head/eyeRight"] = ball.centre
    joints = []
    for path, position in found.items():
        leaf = path.rpartition("/")[2]
        radius = next((size for name, size in RADII.items() if leaf.startswith(name)), None)
        x, y, z = map(float, position)
        joints.append(
            JointSpec(path=path, position=(x, y, z), radius=radius, regions=("mouth_lower",) if leaf == "jaw" else ())
        )
    return JointSet(joints=tuple(joints), parts=parts or {}, unit="mm")


@cache
def head(kind: str) -> FaceParts:
    """The parts of a head as it comes, without its materials: the sample, small or whole, ICT, or MakeHuman."""
    if kind == "sample":
        parts = make()
    elif kind == "whole sample":
        parts = heads.make(controls="bones")
    elif kind == "ict":
        parts = ict.read(shared("ict_facekit/ict_facekit.npz"), ict.Options()).parts
    else:
        parts = makehuman.read(shared("makehuman/makehuman_head.npz"), makehuman.Options()).parts
    return replace(with_meshes(parts, material=None, material_faces=()), materials=())


def without_joints(parts: FaceParts) -> FaceParts:
    """The same face, its skeleton and skin taken away."""
    parts = with_meshes(parts, skin=None)
    return replace(parts, skeleton=Skeleton(), animations=(), sliders=(), bone_limits=None)


def retopologised(parts: FaceParts) -> FaceParts:
    """The same face but for one polygon of its last mesh: on another topology."""
    *others, last = parts.meshes
    count = int(last.face_vertex_counts[-1])
    indices = last.face_vertex_indices[:-count]
    rest = Mesh(
        name=last.name,
        points=last.points,
        face_vertex_counts=last.face_vertex_counts[:-1],
        face_vertex_indices=indices,
        transform=last.transform,
        skin=last.skin,
    )
    return replace(parts, meshes=(*others, rest))


def weights_of(face: Face) -> np.ndarray:
    """(n, j) dense weights of all points."""
    return np.asarray(face.rig().influences.toarray()[:, : len(face.skeleton.joints)])


TWO = JointSet(
    joints=(JointSpec(path="a", position=(0, 0, 0)), JointSpec(path="a/b", position=(0, -40, 60))), unit="mm"
)


def changed(parts: FaceParts, change: Callable[[Mesh], Mesh], name: str = "Head") -> FaceParts:
    """The face with one mesh changed."""
    return replace(parts, meshes=tuple(change(mesh) if mesh.name == name else mesh for mesh in parts.meshes))


@cache
def bare() -> FaceParts:
    """The sample without joints and shapes."""
    parts = without_joints(head("sample"))
    return with_meshes(parts, blendshapes=(), normals=None)


def skinned(parts: FaceParts, skin: SkinFace) -> tuple[Face, Array, SkinReport]:
    """Face, weights and report; what must hold of any weights, without a word on stderr."""
    face = Face.from_parts(parts)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        report = skin(face)
    face = Face(face.stage)
    weights = weights_of(face)
    assert np.isfinite(weights).all()
    assert weights.min() >= 0
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-6)
    assert (weights > 0).sum(axis=1).max() <= 4
    return face, weights, report
