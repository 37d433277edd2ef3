"""The parts of a face that glTF has no place for, stored beside it so that `facepipe import gltf` restores the face."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np

from facepipe.core.arrays import IntArray
from facepipe.parts import Animation, FaceParts, Mesh, Recipe, Skeleton, UvSet
from facepipe.rig.sliders import kept, kept_outputs, with_mutual_mirrors
from facepipe_gltf.baking import Baked
from facepipe_gltf.options import Options
from facepipe_gltf.placement import Space
from facepipe_gltf.primitives import by_material
from facepipe_gltf.record_format import (
    NONE,
    PER_POINT,
    MeshRecord,
    Record,
    image_digest,
    points_back,
    shape_names,
    steps_between,
)


def record_of(
    parts: FaceParts,
    meshes: Sequence[Baked],
    space: Space,
    options: Options,
    animations: Collection[str],
    colored: Collection[str],
) -> Record | None:
    """The record of the face; None where the face can't be restored, because its joints are baked into points, or
    need not be.

    :param animations: names of those in the file
    :param colored: names of meshes whose display colours are in the file
    """
    if options.mode == "morph" or any(len(mesh.placement.matrices) > 1 for mesh in meshes) or not options.restorable:
        return None
    # joints and shapes of animations by number: faces have hundreds of poses that name the same hundreds
    face = _husk(parts, meshes, animations, colored)
    joints, shapes = list(face.skeleton.joints), shape_names(face.meshes)
    return Record(
        face=replace(face, animations=tuple(replace(animation, joints=(), shapes=()) for animation in face.animations)),
        meshes=tuple(_mesh_record(mesh, exact=not options.quantize) for mesh in meshes),
        joints=tuple(_numbers(animation.joints, joints) for animation in face.animations),
        shapes=tuple(_numbers(animation.shapes, shapes) for animation in face.animations),
        axes=space.axes,
        placement=space.placement,
    )


def _husk(
    parts: FaceParts, meshes: Sequence[Baked], animations: Collection[str], colored: Collection[str]
) -> FaceParts:
    """The face without what the file holds elsewhere, and without sliders that move nothing in the file."""
    skinned = any(mesh.influences is not None for mesh in meshes)
    skeleton = parts.skeleton if skinned else replace(Skeleton(), name=parts.skeleton.name)
    joints = set(skeleton.joints)
    shapes = {sculpt.shape for mesh in meshes for sculpt in mesh.sculpts}
    pairs = [(slider, kept(slider, joints.__contains__, shapes.__contains__)) for slider in parts.sliders]
    # readers of the file have no basis of people, whose modes some move
    sliders = [
        own for one, own in pairs if not one.modes and (own.channels or own.shapes or not (one.channels or one.shapes))
    ]
    network = parts.slider_network
    if network is not None:
        network = kept_outputs(network, joints.__contains__, shapes.__contains__)
    # a network can't run without one of its inputs: it goes whole
    if network is not None and not {slider.name for slider in sliders}.issuperset(network.sliders):
        network = None
    # the materials whose images are in the file, with digests in place of images
    used = {name for mesh in meshes for name, _ in by_material(mesh)}
    used |= {other for one in parts.materials if one.name in used for other in one.variants.values()}
    # how the face was made before it went through glTF: an import of our own file notes it
    recipe = parts.recipe
    if recipe is not None and recipe.verb == "import gltf" and "made" in recipe.options:
        made = recipe.options["made"]
        if isinstance(made, dict) and set(made) == {field.name for field in fields(Recipe)}:
            recipe = Recipe(**made | {"sources": tuple(made["sources"]), "digests": tuple(made["digests"])})
        else:
            recipe = None
    return replace(
        parts,
        meshes=tuple(_mesh_husk(mesh, mesh.mesh.name in colored) for mesh in meshes),
        skeleton=skeleton,
        animations=tuple(
            _animation_husk(animation, joints, shapes) for animation in parts.animations if animation.name in animations
        ),
        played=parts.played if parts.played in animations else None,
        person=parts.person if parts.person in animations else None,
        sliders=with_mutual_mirrors(sliders),
        person_basis=None,
        slider_network=network,
        bone_limits=parts.bone_limits if joints else None,
        attach_joint=parts.attach_joint if joints else None,
        materials=tuple(
            one.with_textures(lambda texture: replace(texture, data=image_digest(texture.data)))
            for one in parts.materials
            if one.name in used or not one.textured
        ),
        recipe=recipe,
    )


def _mesh_husk(baked: Baked, colored: bool) -> Mesh:
    mesh = baked.mesh
    # a polygon comes back from its n - 2 triangles: where one is left out, they can't be told apart
    counts = np.asarray(mesh.face_vertex_counts)
    whole = bool(counts.min(initial=3) >= 3) and len(baked.corners.faces) == int((counts - 2).sum())
    normals = None if mesh.normals is None else PER_POINT if len(mesh.normals) == len(mesh.points) else NONE
    shapes = {sculpt.shape for sculpt in baked.sculpts}
    return replace(
        mesh,
        points=NONE,
        face_vertex_counts=mesh.face_vertex_counts if whole else NONE,
        face_vertex_indices=NONE,
        normals=normals,
        uv_sets=tuple(
            UvSet(name=uv_set.name, values=NONE, indices=None if uv_set.indices is None else NONE.astype(np.int32))
            for uv_set in mesh.uv_sets
        ),
        colors=NONE
        if colored and mesh.colors is not None
        else (None if mesh.colors is None else np.asarray(mesh.colors, np.float32)),
        regions={name: np.asarray(mask, np.float32) for name, mask in mesh.regions.items()},
        skin=None
        if mesh.skin is None or baked.influences is None
        else replace(mesh.skin, joint_indices=NONE, joint_weights=NONE),
        blendshapes=tuple(
            replace(shape, point_indices=NONE).changed(lambda _: NONE, lambda _: NONE)
            for shape in mesh.blendshapes
            if shape.name in shapes
        ),
        material_faces=mesh.material_faces if whole else (),
    )


def _animation_husk(animation: Animation, joints: Collection[str], shapes: Collection[str]) -> Animation:
    """The animation, reduced to joints and shapes that are in the file."""
    moved = tuple(joint for joint in animation.joints if joint in joints)
    driven = tuple(shape for shape in animation.shapes if shape in shapes)
    held: dict[str, Any] = {
        name: NONE if moved and getattr(animation, name) is not None else None
        for name in ("translations", "rotations", "scales", "coefficients")
    }
    weights = NONE if driven and animation.shape_weights is not None else None
    return replace(animation, joints=moved, shapes=driven if weights is not None else (), shape_weights=weights, **held)


def _numbers(names: Sequence[str], every: Sequence[str]) -> IntArray:
    place = {name: i for i, name in enumerate(every)}
    return np.array([place[name] for name in names], np.int32)


def _mesh_record(baked: Baked, *, exact: bool) -> MeshRecord:
    mesh, matrix = baked.mesh, np.asarray(baked.placement.matrices[0])
    points = np.asarray(mesh.points, np.float32)
    used = np.zeros(len(points), np.bool_)
    used[mesh.face_vertex_indices] = True
    loose = np.flatnonzero(~used)
    back = points_back(matrix, baked.points.astype(np.float32))
    steps = steps_between(back, points) if exact else None
    return MeshRecord(
        point_count=len(points),
        matrix=matrix,
        mirrored=baked.placement.mirrored,
        steps=steps if steps is not None and steps.any() else None,
        loose_points=loose if len(loose) else None,
        loose_positions=points[loose] if len(loose) else None,
    )
