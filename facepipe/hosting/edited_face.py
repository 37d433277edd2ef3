"""A face that went through a host: what the host changed is taken from it, all else stays what it was."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.polygons import point_triangles
from facepipe.parts import Blendshape, FaceParts, Inbetween, Mesh, Skeleton, Skin, UvSet
from facepipe.rig.sliders import kept, kept_outputs, with_mutual_mirrors
from facepipe.rig.trs import rest_worlds
from facepipe.stage.values import same
from facepipe.verbs.blend.result import normal_offsets

_SHARE = 1e-6  # weights and masks, UVs and colours nearer than this are the same
_STEPS = 2.0**-22  # of the largest coordinate: what float32 loses in base + offset - base

Offsets = tuple[FloatArray, ...]
_TURN = 2e-6  # of a matrix: smaller differences come from a host's float32


def same_topology(mesh: Mesh, other: Mesh) -> bool:
    """Whether two meshes have the same number of points and the same faces."""
    return (
        len(mesh.points) == len(other.points)
        and np.array_equal(mesh.face_vertex_counts, other.face_vertex_counts)
        and np.array_equal(mesh.face_vertex_indices, other.face_vertex_indices)
    )


def edited_mesh(kept: Mesh, made: Mesh) -> Mesh:
    """`made` with the values of `kept` wherever they are the same in the precision of a host, and what it can't hold.

    :param kept: the mesh before
    :param made: the mesh of the same topology as it is now; its blendshapes without normal offsets
    """
    step = _STEPS * float(np.abs(kept.points).max(initial=1e-6))
    moved = bool(np.abs(made.points - kept.points).max(initial=0.0) > step)
    shapes = {shape.name: shape for shape in kept.blendshapes}
    old = {uv_set.name: uv_set for uv_set in kept.uv_sets}

    def corners(uv: UvSet, mesh: Mesh) -> FloatArray:
        return np.asarray(uv.values[mesh.face_vertex_indices if uv.indices is None else uv.indices])

    same_regions = kept.regions.keys() == made.regions.keys() and all(
        _near(kept.regions[name], made.regions[name]) for name in kept.regions
    )
    # hosts store the material of each face: where that was one of the whole mesh, it stays so
    whole = made.material is None and kept.material in {faces.material for faces in made.material_faces}
    subsets = dict(made.point_subsets)
    for name in subsets.keys() & kept.point_subsets.keys():
        if np.array_equal(np.unique(kept.point_subsets[name]), np.unique(subsets[name])):
            subsets[name] = kept.point_subsets[name]
    skin, count = made.skin, len(kept.points)
    if kept.skin is not None and skin is not None:
        before, now, none = joint_table(kept.skin, count), joint_table(skin, count), np.zeros(count)
        same_skin = all(_near(before.get(joint, none), now.get(joint, none)) for joint in {*before, *now})
        own_bind = replace(skin, geom_bind_transform=kept.skin.geom_bind_transform)
        skin = kept.skin if same_skin else own_bind
    result = replace(
        kept,
        points=made.points if moved else kept.points,
        normals=made.normals if moved and kept.normals is not None else kept.normals,
        uv_sets=tuple(
            old[uv_set.name]
            if uv_set.name in old and _near(corners(old[uv_set.name], kept), corners(uv_set, made))
            else uv_set
            for uv_set in made.uv_sets
        ),
        colors=kept.colors if _near(kept.colors, made.colors) else made.colors,
        blendshapes=tuple(_edited_shape(shapes.get(shape.name), shape, count, step) for shape in made.blendshapes),
        regions=kept.regions if same_regions else summed_to_one(made.regions),
        point_subsets=subsets,
        skin=skin,
        material=kept.material if whole else made.material,
        material_faces=made.material_faces,
    )
    again = {shape.name for shape in result.blendshapes if moved or shape is not shapes.get(shape.name)}
    return with_normal_offsets(result, again)


def _edited_shape(kept: Blendshape | None, made: Blendshape, count: int, step: float) -> Blendshape:
    """The shape as it is now; `kept` itself where nothing in it moved by more than `step`."""
    if kept is None:
        return made
    old, new = _sculpts(kept, count), _sculpts(made, count)
    same = {name: np.abs(old[name] - new[name]).max(axis=1) <= step for name in new if name in old}
    weights = {inbetween.name: inbetween.weight for inbetween in kept.inbetweens}
    at = {inbetween.name: inbetween.weight for inbetween in made.inbetweens}
    if old.keys() == new.keys() and weights == at and all(mask.all() for mask in same.values()):
        return kept
    mixed = {name: np.where(same[name][:, None], old[name], new[name]) if name in same else new[name] for name in new}
    touched = np.flatnonzero(np.any([np.any(one != 0, axis=1) for one in mixed.values()], axis=0))
    return sculpted(made.name, mixed[""], {name: (at[name], mixed[name]) for name in at}, touched)


def sculpted(
    name: str, offsets: FloatArray, inbetweens: Mapping[str, tuple[float, FloatArray]], touched: IntArray | None = None
) -> Blendshape:
    """A blendshape of dense offsets (n, 3), and of inbetweens name -> (weight, offsets (n, 3)).

    :param touched: indices of the points it holds; default those that some sculpt moves
    """
    if touched is None:
        dense = [offsets, *(one for _, one in inbetweens.values())]
        touched = np.flatnonzero(np.any([np.any(one != 0, axis=1) for one in dense], axis=0))
    return Blendshape(
        name=name,
        point_indices=touched.astype(np.int32),
        offsets=offsets[touched].astype(np.float32),
        inbetweens=tuple(
            Inbetween(name=inbetween, weight=weight, offsets=dense[touched].astype(np.float32))
            for inbetween, (weight, dense) in sorted(inbetweens.items(), key=lambda item: item[1][0])
        ),
    )


def with_normal_offsets(mesh: Mesh, names: set[str]) -> Mesh:
    """The mesh with the normal offsets of some of its shapes computed from its surface."""
    if not names:
        return mesh
    triangles = point_triangles(mesh.face_vertex_counts, mesh.face_vertex_indices)
    points = np.asarray(mesh.points, dtype=np.float64)

    def turned(at: IntArray, offsets: FloatArray) -> FloatArray:
        deformed = points.copy()
        deformed[at] += offsets
        return normal_offsets(points, deformed, triangles, at).astype(np.float32)

    def with_normals(shape: Blendshape) -> Blendshape:
        at = shape.point_indices
        between = tuple(replace(one, normal_offsets=turned(at, one.offsets)) for one in shape.inbetweens)
        return replace(shape, normal_offsets=turned(at, shape.offsets), inbetweens=between)

    shapes = (with_normals(shape) if shape.name in names else shape for shape in mesh.blendshapes)
    return replace(mesh, blendshapes=tuple(shapes))


def summed_to_one(regions: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """The masks with sum 1 at every point that is in some."""
    if not regions:
        return {}
    total = np.sum([np.asarray(mask, np.float64) for mask in regions.values()], axis=0)
    return {name: (mask / np.where(total > 0, total, 1.0)).astype(np.float32) for name, mask in regions.items()}


def joint_table(skin: Skin, points: int) -> dict[int, FloatArray]:
    """Joint -> (n,) weights, of joints with some."""
    table: dict[int, FloatArray] = {}
    for joint in np.unique(skin.joint_indices[skin.joint_weights != 0]).tolist():
        table[joint] = np.where(skin.joint_indices == joint, skin.joint_weights, 0.0).sum(axis=1).reshape(points)
    return table


def _sculpts(shape: Blendshape, count: int) -> dict[str, FloatArray]:
    """Dense offsets (n, 3) of the shape, called '', and of its inbetweens by name."""
    dense = {}
    for name, offsets in [("", shape.offsets), *((one.name, one.offsets) for one in shape.inbetweens)]:
        dense[name] = np.zeros((count, 3), dtype=np.float32)
        dense[name][shape.point_indices] = offsets
    return dense


def _near(one: FloatArray | None, other: FloatArray | None) -> bool:
    if one is None or other is None:
        return one is other
    return np.shape(one) == np.shape(other) and bool(np.abs(np.subtract(one, other)).max(initial=0.0) <= _SHARE)


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
    result = []
    for slider in before.sliders:
        rest = kept(slider, joints.__contains__, shapes.__contains__)
        if (slider.channels or slider.shapes) and not rest.channels and not rest.shapes:
            warnings.append(f"slider {slider.name}: left out, all that it moves is gone")
        else:
            result.append(rest)
    sliders = with_mutual_mirrors(result)
    network, named = before.slider_network, {slider.name for slider in sliders}
    if network is not None:
        network = kept_outputs(network, joints.__contains__, shapes.__contains__)
        if network is None or not named.issuperset(network.sliders):
            warnings.append("slider network: left out, its sliders or all that it adds to are gone")
            network = None
    same_joints = before.skeleton.joints == skeleton.joints
    if before.bone_limits is not None and not same_joints:
        warnings.append("bone limits left out: the joints have changed")
    parts = replace(
        before,
        meshes=meshes,
        skeleton=skeleton,
        sliders=sliders,
        slider_network=network,
        bone_limits=before.bone_limits if same_joints else None,
        animations=tuple(animation for animation in before.animations if joints.issuperset(animation.joints)),
        materials=made.materials,
    )
    if before.variants and not parts.variants:
        warnings.append("variants of materials left out: the materials are the host's")
    if len(parts.animations) < len(before.animations):
        warnings.append("animations of joints that are gone: left out")
    if before.recipe is not None:
        # materials are the host's: a recipe makes all else
        bare = [
            replace(
                one, meshes=tuple(replace(mesh, material=None, material_faces=()) for mesh in one.meshes), materials=()
            )
            for one in (before, parts)
        ]
        if not same(*bare):
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
        there = {shape.name for shape in made.blendshapes}
        gone = [shape.name for shape in before.blendshapes if shape.name not in there]
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
        # the skeleton with the joints of `made`, each where it stands from itself or the next above it that was there
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
        was = np.array([bones[anchor] for anchor in anchors]).reshape(-1, 4, 4)
        return replace(
            fresh,
            bind_transforms=_moved(before.bind_transforms[at], was, made.bind_transforms),
            rest_transforms=_local(parents, _moved(rest_worlds(before)[at], was, made.bind_transforms)),
        )
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
