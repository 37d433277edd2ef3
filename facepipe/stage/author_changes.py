"""Results authored as override layers: only what differs from the face that the layer stands on."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping

import numpy as np
from pxr import Sdf, Usd, UsdSkel

from facepipe.core.arrays import FloatArray, require_finite
from facepipe.core.errors import InputError, TopologyError
from facepipe.parts import FaceParts
from facepipe.stage.api_schemas import put
from facepipe.stage.author_animations import author_animation_changes
from facepipe.stage.author_mesh import author_point_values
from facepipe.stage.author_mesh_changes import author_mesh_changes, check_mesh_change
from facepipe.stage.author_photos import author_photo_changes, check_photos
from facepipe.stage.author_rig_changes import (
    author_limit_changes,
    author_skeleton_changes,
    author_slider_changes,
    author_text_changes,
    check_skeleton_change,
)
from facepipe.stage.author_skeleton import check_sliders
from facepipe.stage.author_slider_network import author_network_change
from facepipe.stage.differences import same
from facepipe.stage.face import Face
from facepipe.stage.opinions import editable
from facepipe.stage.property_names import check_property_name
from facepipe.stage.read_mesh import read_point_values
from facepipe.stage.read_photos import is_photo
from facepipe.stage.read_slider_network import check_face_network
from facepipe.stage.traversal import prims_below

_FIXED = ("name", "meters_per_unit", "up_axis", "materials")


def author_changes(face: Face, parts: FaceParts, primvars: Mapping[str, FloatArray] | None = None) -> tuple[str, ...]:
    """Author on a face what differs between it and `parts`, compared in float32; one line per thing authored.

    `face` stands over an override layer (`Face.deriving`); what it has read stays as it was. A face without joints can
    get some, one with joints keeps them. What weaker layers have
    and `parts` lacks is hidden: values are blocked, prims deactivated. Time samples of what changes no longer count.
    Instances that hold changed prims are instanced no more.

    :param primvars: more float values (n,) per point of all meshes in stage order, by primvar name; a mesh whose
        values are all NaN gets none
    :raises TopologyError: other meshes, joints, points or faces than the face has
    :raises InputError: NaN, a name that USD can't hold, a difference in a field that stays as it is, or a face that was
        authored on since it was read
    """
    old, values = face.parts(), dict(primvars or {})
    _check(face, old, parts)
    for name, array in values.items():
        _check_point_values(face, name, array)
    meshes = [face.mesh_prim(mesh.name).GetPath() for mesh in old.meshes]
    (skeleton,) = _paths(face, UsdSkel.Skeleton)
    animations = _paths(face, UsdSkel.Animation)
    at, shared = face.stage.GetPrimAtPath, _shared_targets(face, meshes)  # prims of instances change
    photos = [prim.GetPath() for prim in prims_below(face.prim, face.where) if is_photo(prim)]
    if (len(animations), len(photos)) != (len(old.animations), len(old.photos)):
        raise InputError(face.where, "its stage has changed since it was read, expected a new Face of it")
    lines: list[str] = []
    for path, before, after in zip(meshes, old.meshes, parts.meshes, strict=True):
        lines += author_mesh_changes(at(path), before, after, at(skeleton), parts.skeleton.joints, shared)
    if lines:
        _hide_extents(at(path) for path in (face.prim.GetPath(), skeleton))
    lines += _author_point_values(face, meshes, values)
    lines += author_skeleton_changes(at(skeleton), old.skeleton, parts.skeleton)
    lines += author_limit_changes(at(skeleton), old.bone_limits, parts.bone_limits)
    prims = [at(path) for path in animations]
    lines += author_animation_changes(face.prim, prims, old.animations, parts.animations, parts.skeleton)
    lines += author_photo_changes(face.prim, [at(path) for path in photos], old.photos, parts.photos)
    lines += author_slider_changes(face.prim, old.sliders, parts.sliders)
    lines += author_network_change(face.prim, old.slider_network, parts.slider_network)
    return (*lines, *author_text_changes(face.prim, old, parts))


def _check(face: Face, old: FaceParts, new: FaceParts) -> None:
    require_finite(new, face.where)
    names = [[mesh.name for mesh in parts.meshes] for parts in (old, new)]
    if names[0] != names[1]:
        raise TopologyError(face.where, f"meshes {', '.join(names[1])}, expected {', '.join(names[0])}")
    for before, after in zip(old.meshes, new.meshes, strict=True):
        check_mesh_change(f"{face.where} -> {before.name}", before, after)
    check_skeleton_change(face.where, old.skeleton, new.skeleton)
    check_sliders(face.where, new.sliders)
    check_photos(face.where, new.photos)
    check_face_network(face.where, new)
    for field in ("name", "transform"):
        if not same(getattr(old.skeleton, field), getattr(new.skeleton, field)):
            raise InputError(f"{face.where} -> {old.skeleton.name} -> {field}", "differs, expected as on the face")
    for field in _FIXED:
        if not same(getattr(old, field), getattr(new, field)):
            raise InputError(f"{face.where} -> {field}", "differs, expected as on the face")


def _check_point_values(face: Face, name: str, values: FloatArray) -> None:
    check_property_name(face.where, "primvar", name)
    count = sum(len(mesh.points) for mesh in face.meshes)
    if np.shape(values) != (count,):
        raise InputError(f"{face.where} -> {name}", f"values of shape {np.shape(values)}, expected ({count},)")
    for mesh, own in zip(face.meshes, _per_mesh(face, values), strict=True):
        if not np.isfinite(own).all() and not np.isnan(own).all():
            raise InputError(f"{face.where} -> {mesh.name} -> {name}", "NaN or infinity, expected finite numbers")


def _per_mesh(face: Face, values: FloatArray) -> list[FloatArray]:
    ends = np.cumsum([len(mesh.points) for mesh in face.meshes])
    return np.split(np.asarray(values), ends[:-1])


def _paths(face: Face, schema: type) -> list[Sdf.Path]:
    return [prim.GetPath() for prim in prims_below(face.prim, face.where) if prim.IsA(schema)]


def _shared_targets(face: Face, meshes: list[Sdf.Path]) -> set[Sdf.Path]:
    """BlendShape prims that are the target of more than one shape."""
    prims = [face.stage.GetPrimAtPath(path) for path in meshes]
    count = Counter(one for prim in prims for one in UsdSkel.BindingAPI(prim).GetBlendShapeTargetsRel().GetTargets())
    return {path for path, times in count.items() if times > 1}


def _hide_extents(prims: Iterable[Usd.Prim]) -> None:
    """Bounds that were authored above the meshes no longer hold; USD computes what is not authored."""
    for prim in prims:
        for name in ("extent", "extentsHint"):
            put(editable(prim).GetAttribute(name), None)


def _author_point_values(face: Face, meshes: list[Sdf.Path], primvars: Mapping[str, FloatArray]) -> list[str]:
    lines = []
    for name, values in primvars.items():
        for path, mesh, own in zip(meshes, face.meshes, _per_mesh(face, values), strict=True):
            prim: Usd.Prim = face.stage.GetPrimAtPath(path)
            if not np.isnan(own).all() and not same(read_point_values(prim, name, len(mesh.points)), own):
                author_point_values(editable(prim), name, own)
                lines.append(f"{mesh.name}: {name}")
    return lines
