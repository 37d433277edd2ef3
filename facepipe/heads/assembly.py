"""A face of the package data and what is known of a person."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.threads import one_thread
from facepipe.heads.asset import ATTRIBUTION, Asset, Part, asset
from facepipe.heads.controls import bone_sliders, identity_shapes, identity_sliders
from facepipe.heads.expressions import TALK, animations, sliders
from facepipe.heads.part_fits import Shapes, fit_eyes, fit_mouth
from facepipe.heads.people import draw
from facepipe.heads.surfaces import dressed, laid_again
from facepipe.parts import (
    Blendshape,
    BoneLimits,
    FaceParts,
    Inbetween,
    Landmarks,
    MaterialFaces,
    Mesh,
    Recipe,
    Skeleton,
    Skin,
    UvSet,
)

Controls = Literal["measures", "bones"]
BLINKS = ("eyeBlinkLeft", "eyeBlinkRight")


@one_thread()
def make(seed: int = 0, *, textures: int = 0, controls: Controls = "measures") -> FaceParts:
    """A person's head; seed 0 is the average one. Same seed, same arrays, and one topology for all.

    :param textures: texels a side of the skin's textures; 0: colours at points, no textures, and so no hair
    :param controls: sliders of measures, over shapes of their own, or sliders over bones
    :raises InputError: a seed below 0
    """
    if seed < 0:
        raise InputError("seed", f"is {seed}, expected 0 or more")
    who = draw(seed)
    made = dressed(make_head(who.identity, controls), who.look, textures or None)
    return replace(
        made, recipe=Recipe(verb="sample", options={"seed": seed, "textures": textures, "controls": controls})
    )


def make_head(identity: FloatArray, controls: Controls = "measures") -> FaceParts:
    """The bare head of a person, in centimetres: without materials.

    :param identity: (100,) weights of the identity modes, in standard deviations
    """
    head = asset()
    points = head.points + np.tensordot(np.asarray(identity, np.float32), head.modes, axes=1)
    points, shapes = fit_eyes(fit_mouth(points), head.shapes)
    if controls == "measures":
        shapes = {**shapes, **identity_shapes()}
    return FaceParts(
        name="Face",
        meters_per_unit=0.01,
        meshes=tuple(_mesh(head, name, part, points, shapes) for name, part in head.parts.items()),
        skeleton=skeleton(points),
        animations=animations(frozenset(head.shapes)),
        played=TALK,
        sliders=(*sliders(frozenset(head.shapes)), *(identity_sliders() if controls == "measures" else bone_sliders())),
        bone_limits=_bone_limits(head.joints),
        attribution=ATTRIBUTION,
    )


def _mesh(head: Asset, name: str, part: Part, points: FloatArray, shapes: Shapes) -> Mesh:
    uvs, uv_indices = np.unique(head.uv_indices[part.corners], return_inverse=True)
    whole = name == "Head"
    masks = head.regions if whole else {region: _all(part, region == part.region) for region in head.regions}
    return Mesh(
        name=name,
        points=points[part.points],
        face_vertex_counts=head.counts[part.faces],
        face_vertex_indices=head.indices[part.corners] - part.points.start,
        uv_sets=(UvSet(values=head.uvs[uvs], indices=uv_indices.reshape(-1).astype(np.int32)),),
        blendshapes=blendshapes_of(part, shapes),
        skin=Skin(joint_indices=head.skin_joints[part.points], joint_weights=head.skin_weights[part.points]),
        regions=masks,
        landmarks=_landmarks(head, name),
        anchor=head.anchor if whole else None,
        material_faces=_material_faces(head, part),
    )


def _landmarks(head: Asset, name: str) -> dict[str, Landmarks]:
    if name == "Head":
        return {"multipie68": Landmarks(indices=head.landmarks), "dense": Landmarks(indices=head.dense)}
    return {"pupils": Landmarks(indices=np.array([pupil(name)], np.int32))} if name.startswith("Eyeball") else {}


def pupil(name: str) -> int:
    """The foremost point of an eye, as its mesh numbers them."""
    head = asset()
    return int(head.points[head.parts[name].points, 2].argmax())


def _all(part: Part, value: float) -> FloatArray:
    return np.full(part.points.stop - part.points.start, float(value))


def blendshapes_of(part: Part, shapes: Shapes) -> tuple[Blendshape, ...]:
    """The shapes that move points of a part."""
    blendshapes = []
    for name, offsets_at in shapes.items():
        moves = {weight: offsets[part.points] for weight, offsets in offsets_at.items()}
        moved = np.flatnonzero(np.any([offsets.any(axis=1) for offsets in moves.values()], axis=0))
        if not len(moved):
            continue
        inbetweens = tuple(
            Inbetween(name=f"at{round(100 * weight)}", weight=weight, offsets=offsets[moved])
            for weight, offsets in moves.items()
            if weight != 1.0
        )
        points = moved.astype(np.int32)
        blendshapes.append(
            Blendshape(name=name, point_indices=points, offsets=moves[1.0][moved], inbetweens=inbetweens)
        )
    return tuple(blendshapes)


def _material_faces(head: Asset, part: Part) -> tuple[MaterialFaces, ...]:
    own = head.materials[part.faces]
    return tuple(
        MaterialFaces(material=head.material_names[number], faces=np.flatnonzero(own == number).astype(np.int32))
        for number in np.unique(own)
    )


def skeleton(points: FloatArray) -> Skeleton:
    """The skeleton of a head with the points (n, 3), all joints along the axes of the world at rest."""
    head = asset()
    places = np.einsum("jk,jkc->jc", head.joint_shares, points[head.joint_points])
    world = np.tile(np.eye(4), (len(places), 1, 1))
    world[:, :3, 3] = places
    found = Skeleton(joints=head.joints, bind_transforms=world)
    rest, below = world.copy(), found.parents >= 0
    rest[below, :3, 3] -= places[found.parents[below]]
    return Skeleton(joints=head.joints, bind_transforms=world, rest_transforms=rest)


def _bone_limits(joints: tuple[str, ...]) -> BoneLimits:
    """Limits that keep the face whole: 0.8 cm, 0.4 rad and 30 % for face joints, wider turns for jaw, neck and eyes."""
    lower = np.tile(np.repeat([-0.8, -0.4, 0.7], 3), (len(joints), 1))
    upper = np.tile(np.repeat([0.8, 0.4, 1.3], 3), (len(joints), 1))
    for i, joint in enumerate(joints):
        name = joint.rpartition("/")[2]
        if name in ("root", "neck", "head"):
            lower[i, :3], upper[i, :3] = 0.0, 0.0
            lower[i, 3:6], upper[i, 3:6] = -0.7, 0.7
        elif name == "jaw":
            lower[i, 3], upper[i, 3] = -0.05, 0.45
        elif name.startswith(("eye", "lid")):
            lower[i, 3:6], upper[i, 3:6] = -0.6, 0.6
    return BoneLimits(lower=lower, upper=upper)


@one_thread()
def average() -> FaceParts:
    """The bare average head, without materials."""
    return make_head(np.zeros(len(asset().modes)))


def modes() -> FloatArray:
    """(m, n, 3) offsets in centimetres of a standard deviation each, of all meshes' points one after another."""
    return np.asarray(asset().modes, dtype=np.float64)


@one_thread()
def with_parts_fitted(points: FloatArray) -> FloatArray:
    """Points (n, 3) of a person in centimetres, with eyeballs that fit the lids, a mouth's inside behind the skin."""
    return fit_eyes(fit_mouth(points), asset().shapes)[0]


@one_thread()
def with_own_blinks(parts: FaceParts, points: FloatArray) -> FaceParts:
    """A face of the built-in head's topology, whose blinks close the lids of points (n, 3), in centimetres."""
    shapes = fit_eyes(points, asset().shapes)[1]
    own = {name: shapes[name] for name in BLINKS}
    meshes = []
    for mesh in parts.meshes:
        part = asset().parts.get(mesh.name)
        blinks = {} if part is None else {shape.name: shape for shape in blendshapes_of(part, own)}
        meshes.append(replace(mesh, blendshapes=tuple(blinks.get(shape.name, shape) for shape in mesh.blendshapes)))
    return replace(parts, meshes=tuple(meshes))


@one_thread()
def with_own_cards(parts: FaceParts, before: FaceParts) -> FaceParts:
    """A face of the built-in head's topology, whose hair, brows and lashes lie on its skin as they did `before`.

    Cards that somebody has changed stay as they are.
    """
    old, new = (next(mesh for mesh in face.meshes if mesh.name == "Head") for face in (before, parts))
    cards = {mesh.name: laid_again(mesh, old, new) for mesh in before.meshes}
    meshes = []
    for mesh in parts.meshes:
        laid = cards.get(mesh.name)
        if laid is not None:
            mesh = replace(mesh, points=laid.points, normals=laid.normals, blendshapes=laid.blendshapes)
        meshes.append(mesh)
    return replace(parts, meshes=tuple(meshes))
