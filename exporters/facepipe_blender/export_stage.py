"""Faces put on a stage that Blender is about to save, in place of Blender's prims of their objects."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

from pxr import Sdf, Usd, UsdGeom, UsdLux, UsdShade

from facepipe.core.errors import InputError
from facepipe.core.names import identifier, unique_identifiers
from facepipe.hosting.host_face import author_neural_rig, face_layer, is_face
from facepipe.parts import FaceParts

from .build_face import Built, build_face
from .face_objects import FaceObjects, faces_among
from .stage_view import StageView

_BARE = ("", "Xform", "Scope", "SkelRoot")


def export_faces(stage: Usd.Stage, objects: Iterable[Any], active: Any = None) -> tuple[str, ...]:
    """Replace Blender's prims of faces by faces; all of them or, after an error, none.

    :param objects: those of the scene; which of them are on the stage is seen there
    :param active: an object whose face becomes the default prim
    :returns: one line for each thing that was left out
    :raises InputError, SchemaError: a face that can't be written
    """
    view, objects = StageView(stage), list(objects)
    faces, warnings = _on_stage(view, objects)
    if not faces:
        return warnings
    faces = tuple(sorted(faces, key=lambda one: active not in (one.armature, *one.meshes)))
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
        _put(work, path, one.parts, view)
        author_neural_rig(work, path, one.neural_rig, view.folder)
    _finish(work, built, empty=empty, alone=alone)
    stage.GetRootLayer().TransferContent(work)
    return (*warnings, *(line for one in built for line in one.warnings))


def _on_stage(view: StageView, objects: Sequence[Any]) -> tuple[tuple[FaceObjects, ...], tuple[str, ...]]:
    """The faces that Blender wrote, and a line for each of their objects that it left out."""
    faces, warnings = [], []
    for face in faces_among(objects):
        there = replace(face, meshes=tuple(mesh for mesh in face.meshes if view.prim(mesh) is not None))
        if not there.meshes or not there.is_face:
            continue
        if face.armature is not None and view.prim(face.armature) is None:
            name = there.meshes[0].name
            warnings.append(f"{face.armature.name}: hidden or not chosen, without it {name} is exported as no face")
            continue
        away = [mesh.name for mesh in face.meshes if mesh not in there.meshes]
        warnings += [f"{name}: hidden or not chosen, left out of the face of {face.first.name}" for name in away]
        faces.append(there)
    return tuple(faces), tuple(warnings)


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
    return all(_is_bare(prim) for prim in stage.TraverseAll())


def _is_bare(prim: Usd.Prim) -> bool:
    if prim.IsA(UsdShade.Material) or prim.IsA(UsdShade.Shader) or prim.IsA(UsdShade.NodeGraph):
        return True
    return prim.GetTypeName() in _BARE or prim.IsA(UsdLux.DomeLight)


def _put(layer: Sdf.Layer, path: Sdf.Path, parts: FaceParts, view: StageView) -> None:
    """Copy the face to a path, with the materials that Blender wrote."""
    source = face_layer(replace(parts, frames_per_second=view.stage.GetTimeCodesPerSecond()))
    if not Sdf.CopySpec(source, source.rootPrims[0].path, layer, path):
        raise InputError(path, "can't be written on the stage")
    names = unique_identifiers(one.name for one in parts.materials)
    for material, name in zip(parts.materials, names, strict=True):
        there, written = path.AppendPath(f"Materials/{name}"), view.material(material.name)
        if written is not None and not Sdf.CopySpec(view.stage.GetRootLayer(), written, layer, there):
            raise InputError(there, "can't be written on the stage")


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
