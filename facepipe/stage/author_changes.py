"""Results authored as override layers: only what differs from the face that the layer stands on."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from pxr import Sdf, Usd, UsdSkel

from facepipe.core import tokens
from facepipe.core.arrays import FloatArray, require_finite
from facepipe.core.errors import InputError, TopologyError
from facepipe.parts import BoneLimits, FaceParts, Mesh, Recipe, Skeleton, Slider
from facepipe.stage.animations import author_animation_changes
from facepipe.stage.api_schemas import check_property_name, put, put_value, remove_schema
from facepipe.stage.author_mesh import author_mesh_changes, author_other_mesh, author_point_values, check_mesh_change
from facepipe.stage.face import Face
from facepipe.stage.photos import author_photo_changes, check_photos, is_photo
from facepipe.stage.prims import editable, prims_below
from facepipe.stage.read_mesh import read_point_values
from facepipe.stage.skeleton import author_limits, author_recipe
from facepipe.stage.sliders import author_network_change, author_sliders, check_face_network, check_sliders
from facepipe.stage.values import require_same, same, to_matrices


def author_changes(face: Face, parts: FaceParts, primvars: Mapping[str, FloatArray] | None = None) -> tuple[str, ...]:
    """Author on a face what differs between it and `parts`, compared in float32; one line per thing authored.

    `face` stands over an override layer (`Face.deriving`); what it has read stays as it was. A face without joints can
    get some, one with joints keeps them. What weaker layers have
    and `parts` lacks is hidden: values are blocked, prims deactivated. Time samples of what changes no longer count.
    Instances that hold changed prims are no longer instanced.

    :param primvars: more float values (n,) per point of all meshes in stage order, by primvar name; a mesh whose
        values are all NaN gets none
    :raises TopologyError: other meshes, joints, points or faces than the face has
    :raises InputError: NaN, a name that USD can't hold, a difference in a field that stays as it is, or a face that was
        authored on since it was read
    """
    old, values = face.parts(), dict(primvars or {})
    _check(face, old, parts)
    for name, array in values.items():
        check_property_name(face.where, "primvar", name)
        count = sum(len(mesh.points) for mesh in face.meshes)
        if np.shape(array) != (count,):
            raise InputError(f"{face.where} -> {name}", f"values of shape {np.shape(array)}, expected ({count},)")
        for mesh, own in zip(face.meshes, _per_mesh(face, array), strict=True):
            if not np.isfinite(own).all() and not np.isnan(own).all():
                raise InputError(f"{face.where} -> {mesh.name} -> {name}", "NaN or infinity, expected finite numbers")
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
    lines += _author_skeleton_changes(at(skeleton), old.skeleton, parts.skeleton)
    lines += _author_limit_changes(at(skeleton), old.bone_limits, parts.bone_limits)
    prims = [at(path) for path in animations]
    lines += author_animation_changes(face.prim, prims, old.animations, parts.animations, parts.skeleton)
    lines += author_photo_changes(face.prim, [at(path) for path in photos], old.photos, parts.photos)
    lines += _author_slider_changes(face.prim, old.sliders, parts.sliders)
    lines += author_network_change(face.prim, old.slider_network, parts.slider_network)
    return (*lines, *_author_text_changes(face.prim, old, parts))


def author_mesh_in_place(face: Face, mesh: Mesh) -> None:
    """Author another mesh over the one of its name, within `Face.deriving`: other points, faces and shapes too.

    What `face` has read stays as it was.

    :raises InputError: no mesh of that name, or one with another transform, material or texture coordinates by name
    """
    require_finite(mesh, face.where)
    prim = face.mesh_prim(mesh.name)
    old = next(candidate for candidate in face.meshes if candidate.name == mesh.name)
    (skeleton,) = _paths(face, UsdSkel.Skeleton)
    shared = _shared_targets(face, [face.mesh_prim(sibling.name).GetPath() for sibling in face.meshes])
    at = face.stage.GetPrimAtPath
    author_other_mesh(prim, old, mesh, at(skeleton), face.skeleton.joints, shared)
    _hide_extents(at(path) for path in (face.prim.GetPath(), skeleton))


def _check(face: Face, old: FaceParts, new: FaceParts) -> None:
    require_finite(new, face.where)
    names = [[mesh.name for mesh in parts.meshes] for parts in (old, new)]
    if names[0] != names[1]:
        raise TopologyError(face.where, f"meshes {', '.join(names[1])}, expected {', '.join(names[0])}")
    for before, after in zip(old.meshes, new.meshes, strict=True):
        check_mesh_change(f"{face.where} -> {before.name}", before, after)
    _check_skeleton_change(face.where, old.skeleton, new.skeleton)
    check_sliders(face.where, new.sliders)
    check_photos(face.where, new.photos)
    check_face_network(face.where, new)
    require_same(face.where, old, new, ("name", "meters_per_unit", "up_axis", "materials"))


def _per_mesh(face: Face, values: FloatArray) -> list[FloatArray]:
    ends = np.cumsum([len(mesh.points) for mesh in face.meshes])
    return np.split(np.asarray(values), ends[:-1])


def _paths(face: Face, schema: type) -> list[Sdf.Path]:
    return [prim.GetPath() for prim in prims_below(face.prim, face.where) if prim.IsA(schema)]


def _shared_targets(face: Face, meshes: list[Sdf.Path]) -> set[Sdf.Path]:
    """BlendShape prims that are the target of more than one shape."""
    prims = [face.stage.GetPrimAtPath(path) for path in meshes]
    count = Counter(
        target for prim in prims for target in UsdSkel.BindingAPI(prim).GetBlendShapeTargetsRel().GetTargets()
    )
    return {path for path, times in count.items() if times > 1}


def _hide_extents(prims: Iterable[Usd.Prim]) -> None:
    """Bounds that were authored above the meshes no longer hold; USD computes what is not authored."""
    for prim in prims:
        for name in ("extent", "extentsHint"):
            put(editable(prim).GetAttribute(name), None)


def _author_point_values(face: Face, meshes: list[Sdf.Path], primvars: Mapping[str, FloatArray]) -> list[str]:
    lines = []
    for name, values in primvars.items():
        for path, mesh, numbers in zip(meshes, face.meshes, _per_mesh(face, values), strict=True):
            prim: Usd.Prim = face.stage.GetPrimAtPath(path)
            if not np.isnan(numbers).all() and not same(read_point_values(prim, name, len(mesh.points)), numbers):
                author_point_values(editable(prim), name, numbers)
                lines.append(f"{mesh.name}: {name}")
    return lines


def _check_skeleton_change(where: str, old: Skeleton, new: Skeleton) -> None:
    """Check that what differs can be authored over a skeleton: joints for one without, with their transforms.

    :raises TopologyError: other joints than it has, or not one bind and rest transform each
    :raises InputError: joint paths that are not parent first, or another name or place of the skeleton
    """
    where = f"{where} -> {old.name}"
    if old.joints and old.joints != new.joints:
        raise TopologyError(where, "other joints, expected those of the face")
    for name, transforms in (("bind", new.bind_transforms), ("rest", new.rest_transforms)):
        if np.shape(transforms) != (len(new.joints), 4, 4):
            raise TopologyError(where, f"{name} transforms {np.shape(transforms)}, expected one (4, 4) per joint")
    if not old.joints and new.joints:
        joints = new.joints
        topology = UsdSkel.Topology(list(joints))
        valid, reason = topology.Validate()
        if not valid or len(set(joints)) != len(joints) or not all(map(Sdf.Path.IsValidPathString, joints)):
            raise InputError(
                where, f"joints that no skeleton can have, expected different paths, parents first {reason}"
            )
    require_same(where, old, new, ("name", "transform"))


def _author_skeleton_changes(prim: Usd.Prim, old: Skeleton, new: Skeleton) -> tuple[str, ...]:
    """Author on a Skeleton prim the joints, bind and rest transforms that differ; the names of these."""
    added: tuple[str, ...] = ()
    if old.joints != new.joints:
        put(UsdSkel.Skeleton(editable(prim)).CreateJointsAttr(), list(new.joints))
        added = (f"{new.name}: {len(new.joints)} joints",)
    if old.names != new.names:
        skeleton = UsdSkel.Skeleton(editable(prim))
        names = skeleton.CreateJointNamesAttr() if new.joint_names else skeleton.GetJointNamesAttr()
        put(names, list(new.joint_names) or None)
        added = added or (f"{new.name}: names of joints",)
    pairs = {
        "bindTransforms": (old.bind_transforms, new.bind_transforms),
        "restTransforms": (old.rest_transforms, new.rest_transforms),
    }
    changed = {name: there for name, (before, there) in pairs.items() if not same(before, there)}
    for name, transforms in changed.items():
        put(editable(prim).GetAttribute(name), to_matrices(transforms))
    return (*added, *(f"{new.name}: {name}" for name in changed))


def _author_limit_changes(prim: Usd.Prim, old: BoneLimits | None, new: BoneLimits | None) -> tuple[str, ...]:
    """Author on a Skeleton prim its bone limits where they differ; a line then."""
    if same(old, new):
        return ()
    prim = editable(prim)
    if new is not None:
        author_limits(prim, new)
    else:
        for name in (tokens.LIMITS_LOWER, tokens.LIMITS_UPPER):
            put_value(prim, name, None)
        remove_schema(prim, tokens.BONE_LIMITS_API)
    return ("bone limits",)


def _author_slider_changes(prim: Usd.Prim, old: Sequence[Slider], new: Sequence[Slider]) -> tuple[str, ...]:
    """Author on the face prim the sliders that differ, and hide those that are gone; a line for each."""
    before, after = ({slider.name: slider for slider in sliders} for sliders in (old, new))
    changed = [slider for slider in new if not same(slider, before.get(slider.name))]
    anew = []
    for slider in changed:
        own = before.get(slider.name)
        if own is not None and same(replace(slider, value=own.value), own):
            put_value(prim, f"{tokens.SLIDER_PREFIX}{slider.name}:value", slider.value)
        else:
            anew.append(slider)
    author_sliders(prim, anew)
    removed = [name for name in before if name not in after]
    for name in removed:
        for attribute in prim.GetAuthoredPropertiesInNamespace(f"{tokens.SLIDER_PREFIX}{name}"):
            if attribute.GetName().rpartition(":")[0] == f"{tokens.SLIDER_PREFIX}{name}":
                put(attribute, None)
        remove_schema(prim, tokens.SLIDER_API, name)
    return tuple(f"slider {name}" for name in (*(slider.name for slider in changed), *removed))


def _author_text_changes(prim: Usd.Prim, old: FaceParts, new: FaceParts) -> tuple[str, ...]:
    """Author on the face prim attribution, attach joint, person and recipe where they differ; a line for each."""
    lines = []
    for name, line, before, after in (
        (tokens.ATTRIBUTION, "attribution", old.attribution, new.attribution),
        (tokens.ATTACH_JOINT, "attach joint", old.attach_joint or "", new.attach_joint or ""),
        (tokens.PERSON, "person", old.person or "", new.person or ""),
    ):
        if before != after:
            put_value(prim, name, after)
            lines.append(line)
    if _content(old.recipe) != _content(new.recipe):
        if new.recipe is not None:
            author_recipe(prim, new.recipe)
        else:
            for attribute in prim.GetAuthoredPropertiesInNamespace(tokens.RECIPE_VERB.rpartition(":")[0]):
                put(attribute, None)
            remove_schema(prim, tokens.RECIPE_API)
        lines.append("recipe")
    return tuple(lines)


def _content(recipe: Recipe | None) -> tuple[object, ...] | None:
    if recipe is None:
        return None
    options = json.dumps(dict(recipe.options), sort_keys=True)
    return recipe.verb, tuple(recipe.sources), tuple(recipe.digests), options, recipe.version
