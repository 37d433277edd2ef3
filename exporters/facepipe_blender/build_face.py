"""The face that objects of Blender make, as parts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.names import identifier, unique_identifiers
from facepipe.hosting.edited_face import edited_face, made_face
from facepipe.hosting.host_face import recipe_from
from facepipe.parts import FaceParts, Material, Mesh

from .armature import joint_paths, read_skeleton, skeleton_at_rest
from .face_objects import FaceObjects
from .read_mesh import read_mesh
from .record import MESH, Kept, kept_in
from .stage_view import StageView

_NEAR = 5e-6  # of a matrix: what float32 angles and scales make of none
_UP = {"Y": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), "Z": np.eye(3)}  # from Z up


class Built(NamedTuple):
    """A face, and one line for each thing that was left out."""

    parts: FaceParts
    warnings: tuple[str, ...]
    neural_rig: tuple[str, ...] = ()  # its link: file, digest, topology


def build_face(face: FaceObjects, view: StageView, own_units: bool) -> Built:
    """The face that exported objects make.

    :param own_units: in the units and up axis that it was imported in, instead of those of the stage
    :raises InputError: what a face can't hold
    :raises SchemaError: a damaged record of the imported face
    """
    warnings: list[str] = []
    kept = None if face.record is None else kept_in(face.record)
    made = _with_materials(_made(face, view, kept, warnings), view, warnings)
    size = max((float(np.abs(mesh.points).max(initial=0.0)) for mesh in made.meshes), default=1.0)
    place = view.matrix(face.first)
    if kept is None:
        return Built(_moved_face(made_face(made), _snapped(place, np.eye(4), size)), tuple(warnings))
    parts, changes = edited_face(kept.parts, made, kept.bones)
    before = kept.parts
    if own_units:
        # (4, 4) matrix from world coordinates of one stage to those of another
        result = np.eye(4)
        result[:3, :3] = _UP[before.up_axis] @ _UP[view.up].T * (view.unit / before.meters_per_unit)
        place = result @ place
    home = _home(before, face)
    # place = moved home: only what was moved in Blender changes the face, not where the import had put it
    moved = _snapped(place, home, size) @ np.linalg.inv(home)
    if not np.array_equal(moved, np.eye(4)):
        parts = parts.placed(moved)
    if not own_units:
        parts = replace(parts, meters_per_unit=view.unit, up_axis=made.up_axis)
    parts = replace(parts, recipe=recipe_from(parts.recipe, Path(kept.file).parent, view.folder))
    return Built(parts, (*warnings, *changes), kept.neural_rig)


def _home(parts: FaceParts, face: FaceObjects) -> FloatArray:
    """(4, 4) place that the face's first object had when it was imported: its skeleton, or a mesh."""
    transforms = {mesh.name: mesh.transform for mesh in parts.meshes}
    own = parts.skeleton.transform
    return own if face.armature is not None else transforms.get(str(face.first.get(MESH, "")), own)


def _made(face: FaceObjects, view: StageView, kept: Kept | None, warnings: list[str]) -> FaceParts:
    skeleton = read_skeleton(face.armature)
    place = {joint: i for i, joint in enumerate(skeleton.joints)}
    joints = {bone: place[path] for bone, path in joint_paths(face.armature).items()} if face.armature else {}
    names = _mesh_names(face.meshes, kept)
    matrix = view.matrix(face.first)
    # the inverse (4, 4) of the place of an object
    if abs(np.linalg.det(matrix[:3, :3])) < 1e-30:
        raise InputError(face.first.name, "is scaled by 0, expected scales above 0")
    first = np.linalg.inv(matrix)
    meshes = []
    for obj, name in zip(face.meshes, names, strict=True):
        mesh = read_mesh(obj, name, joints, view.uv_names(obj), warnings)
        home = None if kept is None else _home(kept.parts, face)
        meshes.append(_in_its_place(mesh, first @ view.matrix(obj), kept, home))
    order = {} if kept is None else {mesh.name: i for i, mesh in enumerate(kept.parts.meshes)}
    return FaceParts(
        name=identifier(face.first.name, "Face"),
        meters_per_unit=view.unit,
        up_axis="Z" if view.up == "Z" else "Y",
        meshes=tuple(sorted(meshes, key=lambda mesh: order.get(mesh.name, len(order)))),
        skeleton=skeleton,
    )


def _mesh_names(meshes: tuple[Any, ...], kept: Kept | None) -> list[str]:
    """Names of meshes: those they were imported under, each once, and of others their own."""
    known = {} if kept is None else {mesh.name for mesh in kept.parts.meshes}
    names: list[str] = []
    for obj in meshes:
        own = str(obj.get(MESH, ""))
        names.append(own if own in known and own not in names else "")
    taken = [name for name in names if name]
    others = [obj.name for obj, name in zip(meshes, names, strict=True) if not name]
    free = iter(unique_identifiers([*taken, *others])[len(taken) :])
    return [name or next(free) for name in names]


def _in_its_place(mesh: Mesh, place: FloatArray, kept: Kept | None, home: FloatArray | None) -> Mesh:
    """The mesh in the space of the face's first object or, where it was imported, of its own object.

    :param place: (4, 4) its object relative to the first
    :param home: (4, 4) place of the first when it was imported
    """
    size = float(np.abs(mesh.points).max(initial=1.0))
    if kept is not None and mesh.name in kept.places:
        then = kept.places[mesh.name]
        return _moved_mesh(mesh, np.linalg.inv(then) @ _snapped(place, then, size))
    moved = _moved_mesh(mesh, _snapped(place, np.eye(4), size))
    if home is None:
        return moved
    skin = None if moved.skin is None else replace(moved.skin, geom_bind_transform=home)
    return replace(moved, transform=home, skin=skin)


def _with_materials(parts: FaceParts, view: StageView, warnings: list[str]) -> FaceParts:
    """The face with a bare material of every name that is on the stage, to be filled with what is there."""
    used = [mesh.material for mesh in parts.meshes] + [
        material_face.material for mesh in parts.meshes for material_face in mesh.material_faces
    ]
    names = [name for name in dict.fromkeys(used) if name and view.material(name) is not None]

    def own(mesh: Mesh) -> Mesh:
        faces = tuple(material_face for material_face in mesh.material_faces if material_face.material in names)
        return replace(mesh, material=mesh.material if mesh.material in names else None, material_faces=faces)

    meshes = tuple(own(mesh) for mesh in parts.meshes)
    return replace(parts, meshes=meshes, materials=tuple(Material(name=name) for name in names))


def _snapped(matrix: FloatArray, to: FloatArray, size: float) -> FloatArray:
    """`to` where the matrix (4, 4) is the same in the precision of Blender; the matrix itself otherwise.

    :param size: of what it moves
    """
    scale = float(np.abs(to[:3, :3]).max())
    off = np.abs(matrix - to) <= np.array([[_NEAR * scale] * 3 + [_NEAR * max(size * scale, 1e-6)]])
    return to if off.all() else matrix


def _moved_mesh(mesh: Mesh, matrix: FloatArray) -> Mesh:
    """The mesh with points, normals and shapes moved by an affine (4, 4) matrix.

    :raises InputError: a matrix that mirrors or flattens
    """
    if np.array_equal(matrix, np.eye(4)):
        return mesh
    linear = matrix[:3, :3]
    if np.linalg.det(linear) <= 0:
        raise InputError(mesh.name, "its object mirrors or flattens it, expected scales above 0 (apply the scale)")
    turn = np.linalg.inv(linear)

    def offsets(values: FloatArray) -> FloatArray:
        return (np.asarray(values, np.float64) @ linear.T).astype(np.float32)

    normals = None
    if mesh.normals is not None:
        turned = np.asarray(mesh.normals, np.float64) @ turn
        normals = (turned / np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-30)).astype(np.float32)
    points = np.asarray(mesh.points, np.float64) @ linear.T + matrix[:3, 3]
    return replace(
        mesh,
        points=points.astype(np.float32),
        normals=normals,
        blendshapes=tuple(shape.changed(offsets, offsets) for shape in mesh.blendshapes),  # none has normals yet
    )


def _moved_face(parts: FaceParts, matrix: FloatArray) -> FaceParts:
    """A face at rest moved by (4, 4): meshes and bones, which keep size 1.

    :raises InputError: a matrix that mirrors, flattens or stretches
    """
    if np.array_equal(matrix, np.eye(4)):
        return parts
    scales = np.linalg.norm(matrix[:3, :3], axis=0)
    if parts.skeleton.joints and np.ptp(scales) > 1e-4 * scales.max():
        x, y, z = scales
        raise InputError(parts.skeleton.name, f"scaled by {x:.4g}, {y:.4g}, {z:.4g}, expected one scale (apply it)")
    bones = matrix @ parts.skeleton.bind_transforms
    bones[:, :3, :3] /= scales.mean()
    return replace(
        parts,
        meshes=tuple(_moved_mesh(mesh, matrix) for mesh in parts.meshes),
        skeleton=skeleton_at_rest(parts.skeleton.name, parts.skeleton.joints, bones).called(parts.skeleton.names),
    )
