"""Faces put on a stage that Blender is about to save, in place of Blender's prims of their objects.

In order: faces put on the stage; the face that objects make, as parts; the stage and Blender's prims on it.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdLux, UsdShade

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.names import identifier, unique_identifiers
from facepipe.hosting.edited_face import edited_face, made_face
from facepipe.hosting.host_face import author_neural_rig, face_layer, is_face, recipe_from
from facepipe.parts import FaceParts, Material, Mesh

from .armature import joint_paths, read_skeleton, skeleton_at_rest
from .face_objects import MESH, FaceObjects, Kept, faces_among, kept_in
from .read_mesh import read_mesh

_BARE = ("", "Xform", "Scope", "SkelRoot")  # types of prims that hold nothing of their own
_NEAR = 5e-6  # of a matrix: what float32 angles and scales make of none
_UP = {"Y": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), "Z": np.eye(3)}  # from Z up
_UV_TYPES = ("texCoord2f[]", "float2[]")
_OBJECT, _DATA = "blender:object_name", "blender:data_name"


def export_faces(stage: Usd.Stage, objects: Iterable[Any], active: Any = None) -> tuple[str, ...]:
    """Replace Blender's prims of faces by faces; all of them or, after an error, none.

    :param objects: those of the scene; which of them are on the stage is seen there
    :param active: an object whose face becomes the default prim
    :returns: one line for each thing that was left out
    :raises InputError, SchemaError: a face that can't be written
    """
    view, objects = StageView(stage), list(objects)
    faces: list[FaceObjects] = []
    warnings: list[str] = []
    for face in faces_among(objects):
        shown = replace(face, meshes=tuple(mesh for mesh in face.meshes if view.prim(mesh) is not None))
        if not shown.meshes or not shown.is_face:
            continue
        if face.armature is not None and view.prim(face.armature) is None:
            name = shown.meshes[0].name
            warnings.append(f"{face.armature.name}: hidden or not chosen, without it {name} is exported as no face")
            continue
        away = [mesh.name for mesh in face.meshes if mesh not in shown.meshes]
        warnings += [f"{name}: hidden or not chosen, left out of the face of {face.first.name}" for name in away]
        faces.append(shown)
    if not faces:
        return tuple(warnings)
    faces.sort(key=lambda one: active not in (one.armature, *one.meshes))
    # on a copy: an error halfway leaves Blender's stage as it was
    work = Sdf.Layer.CreateAnonymous(".usda")
    work.TransferContent(stage.GetRootLayer())
    there = {obj: prim.GetPath() for obj in objects if (prim := view.prim(obj)) is not None}
    own = {there[obj] for face in faces for obj in (face.armature, *face.meshes) if obj is not None}
    empty = _remove(work, own, {*there.values()} - own)
    alone = empty and len(faces) == 1
    built = [build_face(face, view, alone and face.record is not None) for face in faces]
    taken = [spec.name for spec in work.rootPrims]
    names = unique_identifiers([*taken, *(identifier(one.parts.name, "Face") for one in built)])[len(taken) :]
    for path, one in zip([Sdf.Path.absoluteRootPath.AppendChild(name) for name in names], built, strict=True):
        source = face_layer(replace(one.parts, frames_per_second=stage.GetTimeCodesPerSecond()))
        if not Sdf.CopySpec(source, source.rootPrims[0].path, work, path):
            raise InputError(path, "can't be written on the stage")
        own_names = unique_identifiers(material.name for material in one.parts.materials)
        for material, name in zip(one.parts.materials, own_names, strict=True):  # as Blender wrote them
            place, written = path.AppendPath(f"Materials/{name}"), view.material(material.name)
            if written is not None and not Sdf.CopySpec(stage.GetRootLayer(), written, work, place):
                raise InputError(place, "can't be written on the stage")
        author_neural_rig(work, path, one.neural_rig, view.folder)
    _finish(work, built, empty=empty, alone=alone)
    stage.GetRootLayer().TransferContent(work)
    return (*warnings, *(line for one in built for line in one.warnings))


def _remove(layer: Sdf.Layer, faces: set[Sdf.Path], others: set[Sdf.Path]) -> bool:
    """Remove prims of faces; those that hold other objects become bare. Whether nothing but bare prims is left."""
    for path in sorted(faces, reverse=True):
        spec = layer.GetPrimAtPath(path)
        if spec is None:
            continue
        inner = {
            other.GetPrefixes()[path.pathElementCount] for other in others if other != path and other.HasPrefix(path)
        }
        if inner:
            for child in [one.path for one in spec.nameChildren.values() if one.path not in inner]:
                del spec.nameChildren[child.name]
        else:
            del layer.GetPrimAtPath(path.GetParentPath()).nameChildren[path.name]
    stage = Usd.Stage.Open(layer)
    materials = (UsdShade.Material, UsdShade.Shader, UsdShade.NodeGraph, UsdLux.DomeLight)
    return all(prim.GetTypeName() in _BARE or any(map(prim.IsA, materials)) for prim in stage.TraverseAll())


def _finish(layer: Sdf.Layer, built: Sequence[Built], *, empty: bool, alone: bool) -> None:
    """The first face is the default prim; a face alone has its own units, where nothing else is left."""
    stage = Usd.Stage.Open(layer)
    roots = [prim for prim in stage.GetPseudoRoot().GetChildren() if not is_face(prim)]
    faces = [prim for prim in stage.GetPseudoRoot().GetChildren() if is_face(prim)]
    stage.SetDefaultPrim(faces[0])
    for prim in roots if empty else ():
        stage.RemovePrim(prim.GetPath())
    parts = built[0].parts
    if alone:
        UsdGeom.SetStageMetersPerUnit(stage, parts.meters_per_unit)
        UsdGeom.SetStageUpAxis(stage, parts.up_axis)
    times = [animation.times for each in built for animation in each.parts.animations if animation.times is not None]
    if times:
        rate = stage.GetTimeCodesPerSecond()
        stage.SetStartTimeCode(min(float(time[0]) for time in times) * rate)
        stage.SetEndTimeCode(max(float(time[-1]) for time in times) * rate)


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
    made = _made(face, view, kept, warnings)
    size = max((float(np.abs(mesh.points).max(initial=0.0)) for mesh in made.meshes), default=1.0)
    place = view.matrix(face.first)
    if kept is None:
        parts, matrix = made_face(made), _snapped(place, np.eye(4), size)
        if not np.array_equal(matrix, np.eye(4)):  # at rest: meshes move, and bones, which keep size 1
            scales = np.linalg.norm(matrix[:3, :3], axis=0)
            bound = parts.skeleton
            if bound.joints and np.ptp(scales) > 1e-4 * scales.max():
                x, y, z = scales
                raise InputError(bound.name, f"scaled by {x:.4g}, {y:.4g}, {z:.4g}, expected one scale (apply it)")
            bones = matrix @ bound.bind_transforms
            bones[:, :3, :3] /= scales.mean()
            skeleton = skeleton_at_rest(bound.name, bound.joints, bones).called(bound.names)
            parts = replace(parts, meshes=tuple(_moved_mesh(one, matrix) for one in parts.meshes), skeleton=skeleton)
        return Built(parts, tuple(warnings))
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
    # meshes have the names that they were imported under, each once, and others their own
    known = {} if kept is None else {mesh.name for mesh in kept.parts.meshes}
    names: list[str] = []
    for obj in face.meshes:
        own = str(obj.get(MESH, ""))
        names.append(own if own in known and own not in names else "")
    taken = [name for name in names if name]
    others = [obj.name for obj, name in zip(face.meshes, names, strict=True) if not name]
    free = iter(unique_identifiers([*taken, *others])[len(taken) :])
    names = [name or next(free) for name in names]
    matrix = view.matrix(face.first)
    if abs(np.linalg.det(matrix[:3, :3])) < 1e-30:
        raise InputError(face.first.name, "is scaled by 0, expected scales above 0")
    first = np.linalg.inv(matrix)  # world -> first object
    meshes = []
    for obj, name in zip(face.meshes, names, strict=True):
        mesh = read_mesh(obj, name, joints, view.uv_names(obj), warnings)
        home = None if kept is None else _home(kept.parts, face)
        meshes.append(_in_its_place(mesh, first @ view.matrix(obj), kept, home))
    order = {} if kept is None else {mesh.name: i for i, mesh in enumerate(kept.parts.meshes)}
    meshes.sort(key=lambda mesh: order.get(mesh.name, len(order)))
    # a bare material of every name that is on the stage, to be filled with what is there
    used = [mesh.material for mesh in meshes] + [own.material for mesh in meshes for own in mesh.material_faces]
    there = [name for name in dict.fromkeys(used) if name and view.material(name) is not None]
    for i, mesh in enumerate(meshes):
        of_faces = tuple(own for own in mesh.material_faces if own.material in there)
        whole = mesh.material if mesh.material in there else None
        meshes[i] = replace(mesh, material=whole, material_faces=of_faces)
    return FaceParts(
        name=identifier(face.first.name, "Face"),
        meters_per_unit=view.unit,
        up_axis="Z" if view.up == "Z" else "Y",
        meshes=tuple(meshes),
        skeleton=skeleton,
        materials=tuple(Material(name=name) for name in there),
    )


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


class StageView:
    """A stage that Blender is about to save."""

    def __init__(self, stage: Usd.Stage) -> None:
        self.stage = stage
        self.unit = float(UsdGeom.GetStageMetersPerUnit(stage))
        self.up = "Z" if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z else "Y"
        self.folder = Path(stage.GetRootLayer().realPath).parent
        prims = list(stage.TraverseAll())
        self._objects = _by_name((prim for prim in prims if prim.IsA(UsdGeom.Xformable)), _OBJECT)
        self._materials = _by_name((prim for prim in prims if prim.IsA(UsdShade.Material)), _DATA)

    def prim(self, obj: Any) -> Usd.Prim | None:
        """The prim of an object; None where it was not exported."""
        return self._objects.get(str(obj.name)) or self._objects.get(_plain(obj.name))

    def matrix(self, obj: Any) -> FloatArray:
        """(4, 4) matrix from the space of an exported object to the world of the stage."""
        world = UsdGeom.Xformable(self.prim(obj)).ComputeLocalToWorldTransform(Usd.TimeCode.Default())
        return np.array(world, dtype=np.float64).T

    def uv_names(self, obj: Any) -> dict[str, str]:
        """The name on the stage of every exported UV map of a mesh object: one may be called `st` there."""
        meshes = [one for one in Usd.PrimRange(self.prim(obj)) if one.IsA(UsdGeom.Mesh)][:1]
        there = [
            str(primvar.GetPrimvarName())
            for mesh in meshes
            for primvar in UsdGeom.PrimvarsAPI(mesh).GetPrimvarsWithAuthoredValues()
            if str(primvar.GetTypeName()) in _UV_TYPES
        ]
        names = {layer.name: _plain(layer.name) for layer in obj.data.uv_layers if _plain(layer.name) in there}
        left = [layer.name for layer in obj.data.uv_layers if layer.name not in names]
        free = [name for name in there if name not in names.values()]
        return {**names, **dict(zip(left, free, strict=False))}

    def material(self, name: str) -> Sdf.Path | None:
        """The path of the prim of a material."""
        prim = self._materials.get(name) or self._materials.get(_plain(name))
        return None if prim is None else prim.GetPath()


def _by_name(prims: Any, label: str) -> dict[str, Usd.Prim]:
    """Prims by their names in Blender where it authored these, else by their own."""
    labelled: dict[str, Usd.Prim] = {}
    unlabelled: dict[str, Usd.Prim] = {}
    for prim in prims:
        names = [one for one in prim.GetAuthoredPropertyNames() if one == label or one.endswith(f":{label}")]
        if names:
            labelled.setdefault(str(prim.GetAttribute(names[0]).Get()), prim)
        else:
            unlabelled.setdefault(str(prim.GetName()), prim)
    return unlabelled | labelled


def _plain(name: str) -> str:
    """A name as Blender makes it an identifier."""
    text = re.sub(r"\W", "_", str(name))
    return f"_{text}" if text[:1].isdigit() else text
