"""A face that went through a host: what the host changed is taken from it, all else stays what it was."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.hosting.edited_mesh import edited_mesh, same_topology, summed_to_one, with_normal_offsets
from facepipe.parts import BoneLimits, FaceParts, Mesh, Skeleton, Slider, SliderNetwork
from facepipe.rig.slider_network import kept as kept_outputs
from facepipe.rig.sliders import kept, with_mutual_mirrors
from facepipe.rig.trs import rest_worlds
from facepipe.stage.differences import same

_TURN = 2e-6  # of a matrix: smaller differences come from a host's float32


def made_face(made: FaceParts) -> FaceParts:
    """A face that a host made from nothing: regions that sum to 1, normal offsets of its surface."""
    return replace(made, meshes=tuple(_made_mesh(mesh) for mesh in made.meshes))


def edited_face(
    before: FaceParts, made: FaceParts, bones: Mapping[str, FloatArray]
) -> tuple[FaceParts, tuple[str, ...]]:
    """The face as the host has it now, with all that the host can't hold; a line for each thing lost or made anew.

    :param before: the face that the host was given
    :param made: what is in the host now: meshes of the same names, joints of the same paths; what isn't is gone
    :param bones: joint -> (4, 4) matrix in skeleton space, as the host first had it
    """
    warnings: list[str] = []
    skeleton = _skeleton(before.skeleton, made.skeleton, bones, warnings)
    old = {mesh.name: mesh for mesh in _in_order(before, skeleton.joints).meshes}
    made = _in_order(made, skeleton.joints)
    meshes = tuple(_mesh(old.get(mesh.name), mesh, warnings) for mesh in made.meshes)
    gone = [name for name in old if name not in {mesh.name for mesh in made.meshes}]
    warnings += [f"{name}: is gone" for name in gone]
    joints, shapes = {*skeleton.joints}, {shape.name for mesh in meshes for shape in mesh.blendshapes}
    sliders = _sliders(before.sliders, joints, shapes, warnings)
    parts = replace(
        before,
        meshes=meshes,
        skeleton=skeleton,
        sliders=sliders,
        slider_network=_network(before.slider_network, sliders, joints, shapes, warnings),
        bone_limits=_limits(before, skeleton, warnings),
        animations=tuple(animation for animation in before.animations if joints.issuperset(animation.joints)),
        materials=made.materials,
    )
    if len(parts.animations) < len(before.animations):
        warnings.append("animations of joints that are gone: left out")
    if before.recipe is not None and not _unchanged(before, parts):
        warnings.append(f"recipe of '{before.recipe.verb}' left out: the face was edited")
        parts = replace(parts, recipe=None)
    return parts, tuple(warnings)


def _made_mesh(mesh: Mesh) -> Mesh:
    named = replace(mesh, regions=summed_to_one(mesh.regions))
    return with_normal_offsets(named, {shape.name for shape in mesh.blendshapes})


def _mesh(before: Mesh | None, made: Mesh, warnings: list[str]) -> Mesh:
    if before is None:
        return _made_mesh(made)
    if same_topology(before, made):
        gone = [
            blendshape.name
            for blendshape in before.blendshapes
            if blendshape.name not in {shape.name for shape in made.blendshapes}
        ]
        if gone:
            warnings.append(f"{made.name}: shapes {', '.join(gone[:3])} ({len(gone)} in all) are gone")
        return edited_mesh(before, made)
    lost = [*before.landmarks] + ([] if before.anchor is None else ["the anchor"])
    if lost:
        warnings.append(f"{made.name}: topology changed, {', '.join(lost)} left out")
    skin = made.skin
    if skin is not None:
        bind = before.transform if before.skin is None else before.skin.geom_bind_transform
        skin = replace(skin, geom_bind_transform=bind)
    return replace(_made_mesh(made), skin=skin, transform=before.transform, double_sided=before.double_sided)


def _skeleton(before: Skeleton, made: Skeleton, bones: Mapping[str, FloatArray], warnings: list[str]) -> Skeleton:
    """The skeleton before, moved by what its bones moved; joints that are new stand as the host says."""
    if {*before.joints} != {*made.joints}:
        warnings.append(f"{len(made.joints)} joints, {len(before.joints)} before: the skeleton is made anew")
        return _other_joints(before, made, bones)
    if not before.joints:
        return before
    place = {joint: i for i, joint in enumerate(made.joints)}
    now = made.bind_transforms[[place[joint] for joint in before.joints]]
    then = np.array([bones[joint] for joint in before.joints]).reshape(-1, 4, 4)
    size = max(float(np.ptp(then[:, :3, 3], axis=0).max(initial=0.0)), 1e-6)
    still = np.abs(now - then).max(axis=(1, 2)) <= _TURN * max(size, 1.0)
    if still.all():
        return before
    now[still] = then[still]
    return replace(
        before,
        bind_transforms=_moved(before.bind_transforms, then, now),
        rest_transforms=_local(before.parents, _moved(rest_worlds(before), then, now)),
    )


def _other_joints(before: Skeleton, made: Skeleton, bones: Mapping[str, FloatArray]) -> Skeleton:
    """The skeleton with the joints of `made`, each where it stands from itself or the next above it that was there."""
    known = dict(zip(before.joints, before.names, strict=True))
    names = [known.get(joint, name) for joint, name in zip(made.joints, made.names, strict=True)]
    fresh = replace(made, name=before.name, transform=before.transform).called(names)
    old = {joint: i for i, joint in enumerate(before.joints)}
    shared = [joint for joint in made.joints if joint in old]
    if not shared:
        return fresh
    parents = made.parents
    anchors: list[str] = []
    for joint, parent in zip(made.joints, parents, strict=True):
        anchors.append(joint if joint in old else anchors[parent] if parent >= 0 else shared[0])
    at = [old[anchor] for anchor in anchors]
    then = np.array([bones[anchor] for anchor in anchors]).reshape(-1, 4, 4)
    return replace(
        fresh,
        bind_transforms=_moved(before.bind_transforms[at], then, made.bind_transforms),
        rest_transforms=_local(parents, _moved(rest_worlds(before)[at], then, made.bind_transforms)),
    )


def _moved(own: FloatArray, then: FloatArray, now: FloatArray) -> FloatArray:
    """Matrices (j, 4, 4) that stand to `now` as `own` stand to `then`, with their own scales."""
    scales = np.ones((len(own), 1, 4))
    scales[:, 0, :3] = np.linalg.norm(own[:, :3, :3], axis=1)
    result: FloatArray = own / scales @ np.linalg.inv(then) @ now * scales
    return result


def _local(parents: IntArray, world: FloatArray) -> FloatArray:
    """(j, 4, 4) joints relative to their parents."""
    pairs = [(world[parent] if parent >= 0 else np.eye(4), own) for parent, own in zip(parents, world, strict=True)]
    return np.array([np.linalg.solve(*pair) for pair in pairs])


def _in_order(parts: FaceParts, joints: tuple[str, ...]) -> FaceParts:
    """The face with skins that count `joints`; one past the last stands for those that are not there."""
    if parts.skeleton.joints == joints:
        return parts
    place = {joint: i for i, joint in enumerate(joints)}
    table = np.array([place.get(joint, len(joints)) for joint in parts.skeleton.joints] or [0], dtype=np.int32)

    def renumbered(mesh: Mesh) -> Mesh:
        if mesh.skin is None:
            return mesh
        indices = np.where(mesh.skin.joint_weights != 0, table[mesh.skin.joint_indices], 0)
        return replace(mesh, skin=replace(mesh.skin, joint_indices=indices.astype(np.int32)))

    return replace(parts, meshes=tuple(renumbered(mesh) for mesh in parts.meshes))


def _sliders(before: tuple[Slider, ...], joints: set[str], shapes: set[str], warnings: list[str]) -> tuple[Slider, ...]:
    result = []
    for slider in before:
        rest = kept(slider, joints.__contains__, shapes.__contains__)
        if (slider.channels or slider.shapes) and not rest.channels and not rest.shapes:
            warnings.append(f"slider {slider.name}: left out, all that it moves is gone")
        else:
            result.append(rest)
    return with_mutual_mirrors(result)


def _network(
    before: SliderNetwork | None, sliders: tuple[Slider, ...], joints: set[str], shapes: set[str], warnings: list[str]
) -> SliderNetwork | None:
    if before is None:
        return None
    rest = kept_outputs(before, joints.__contains__, shapes.__contains__)
    if rest is None or not {slider.name for slider in sliders}.issuperset(rest.sliders):
        warnings.append("slider network: left out, its sliders or all that it adds to are gone")
        return None
    return rest


def _limits(before: FaceParts, skeleton: Skeleton, warnings: list[str]) -> BoneLimits | None:
    if before.bone_limits is None or before.skeleton.joints == skeleton.joints:
        return before.bone_limits
    warnings.append("bone limits left out: the joints have changed")
    return None


def _unchanged(before: FaceParts, after: FaceParts) -> bool:
    """Whether all that a recipe makes is as it was; materials are the host's."""

    def bare(parts: FaceParts) -> FaceParts:
        meshes = tuple(replace(mesh, material=None, material_faces=()) for mesh in parts.meshes)
        return replace(parts, meshes=meshes, materials=())

    return same(bare(before), bare(after))
