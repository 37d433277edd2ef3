"""Results authored as override layers: only what differs from the face that the layer stands on."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdShade, UsdSkel

from facepipe.core import tokens
from facepipe.core.arrays import FloatArray, require_float32
from facepipe.core.errors import InputError, TopologyError
from facepipe.core.names import unique_identifiers
from facepipe.parts import FaceParts, Mesh, Recipe, Slider
from facepipe.stage.author_mesh import (
    author_mesh,
    author_mesh_changes,
    author_other_mesh,
    author_point_values,
    check_mesh_change,
)
from facepipe.stage.face import OF_NEUTRAL, Face
from facepipe.stage.material_variants import Bindings
from facepipe.stage.photos import author_photo_changes, check_photos, is_photo
from facepipe.stage.prims import check_property_name, editable, prims_below, put, put_value, remove_schema
from facepipe.stage.read_mesh import read_point_values
from facepipe.stage.skeleton import author_animation_changes, author_limits, author_recipe, vrm_text
from facepipe.stage.sliders import (
    author_network_change,
    author_person_basis,
    author_sliders,
    check_face_network,
    check_sliders,
)
from facepipe.stage.values import matrix, require_same, require_writable, same, to_matrices


def author_changes(
    face: Face, parts: FaceParts, primvars: Mapping[str, FloatArray] | None = None, *, into_points: bool = False
) -> tuple[str, ...]:
    """Author on a face what differs between it and `parts`, compared in float32; one line per thing authored.

    `face` stands over an override layer (`Face.deriving`); what it has read stays as it was. A face without joints can
    get some, one with joints keeps them. What weaker layers have and `parts` lacks is hidden: values are blocked, prims
    deactivated. Time samples of what changes no longer count, and instances that hold changed prims are instanced no
    longer.

    :param primvars: more float values (n,) per point of all meshes in stage order, by primvar name; a mesh whose
        values are all NaN gets none
    :param into_points: the neutral of the face's section goes into points, joints and shapes, as it does where these
        change
    :raises TopologyError: other meshes, joints, points or faces than the face has
    :raises InputError: NaN, a name that USD can't hold, a difference in a field that stays as it is, or a face that was
        authored on since it was read
    """
    old = face.parts()
    _check(face, old, parts)
    old, lines = _author_basis(face, old, parts, into_points=into_points)
    values = {name: _per_mesh(face, name, array) for name, array in (primvars or {}).items()}
    meshes = [face.mesh_prim(mesh.name).GetPath() for mesh in old.meshes]
    (skeleton,) = _paths(face, UsdSkel.Skeleton)
    animations = _paths(face, UsdSkel.Animation)
    at, shared = face.stage.GetPrimAtPath, _shared_targets(face, meshes)  # prims of instances change
    photos = [prim.GetPath() for prim in prims_below(face.prim, face.where) if is_photo(prim)]
    if (len(animations), len(photos)) != (len(old.animations), len(old.photos)):
        raise InputError(face.where, "its stage has changed since it was read, expected a new Face of it")
    for path, before, after in zip(meshes, old.meshes, parts.meshes, strict=True):
        lines += author_mesh_changes(at(path), before, after, at(skeleton), parts.skeleton.joints, shared)
    if lines:
        _hide_extents(at(path) for path in (face.prim.GetPath(), skeleton))
    for name, split in values.items():
        for path, mesh, numbers in zip(meshes, face.meshes, split, strict=True):
            present = read_point_values(at(path), name, len(mesh.points))
            if not np.isnan(numbers).all() and not same(present, numbers):
                author_point_values(editable(at(path)), name, numbers)
                lines.append(f"{mesh.name}: {name}")
    lines += _author_skeleton_changes(at(skeleton), old, parts)
    prims = [at(path) for path in animations]
    lines += author_animation_changes(face.prim, prims, old.animations, parts.animations, parts.skeleton)
    lines += author_photo_changes(face.prim, [at(path) for path in photos], old.photos, parts.photos)
    lines += _author_slider_changes(face.prim, old.sliders, parts.sliders)
    lines += author_network_change(face.prim, old.slider_network, parts.slider_network)
    return (*lines, *_author_text_changes(face.prim, old, parts))


def _author_basis(face: Face, old: FaceParts, new: FaceParts, *, into_points: bool) -> tuple[FaceParts, list[str]]:
    """Author on the face prim the basis of its person where it differs, with a line for that.

    The section stays where the neutral stays: else what is authored would be under what the section gives.

    :returns: what else the face differs from, the lines
    """
    before, after = face.person_basis, new.person_basis
    if before is not None and before.section:
        if into_points or not _same_neutral(old, new):
            old = replace(old, **{name: getattr(face.authored, name) for name in OF_NEUTRAL})
        elif after is not None and not after.section and after.digest == before.digest:
            after = before
    if after == before:
        return old, []
    author_person_basis(face.prim, after)
    return old, ["person"]


def _same_neutral(old: FaceParts, new: FaceParts) -> bool:
    """Whether points, shapes and joints are the same."""
    pairs = zip(old.meshes, new.meshes, strict=True)
    fields = ("points", "normals", "blendshapes")
    return same(old.skeleton, new.skeleton) and all(
        same(getattr(one, name), getattr(other, name)) for one, other in pairs for name in fields
    )


def author_mesh_in_place(face: Face, mesh: Mesh) -> None:
    """Author another mesh over the one of its name, within `Face.deriving`: other points, faces and shapes too.

    What `face` has read stays as it was, and the neutral of its section goes into points.

    :raises InputError: no mesh of that name, or one with another transform, material or texture coordinates by name
    """
    require_writable(mesh, face.where)
    if face.person_basis is not None and face.person_basis.section:
        author_changes(face, face.parts(), into_points=True)
    prim = face.mesh_prim(mesh.name)
    old = next(candidate for candidate in face.meshes if candidate.name == mesh.name)
    (skeleton,) = _paths(face, UsdSkel.Skeleton)
    shared = _shared_targets(face, [face.mesh_prim(sibling.name).GetPath() for sibling in face.meshes])
    at = face.stage.GetPrimAtPath
    author_other_mesh(prim, old, mesh, at(skeleton), face.skeleton.joints, shared)
    _hide_extents(at(path) for path in (face.prim.GetPath(), skeleton))


def author_levels(face: Face, levels: Sequence[Sequence[Mesh]]) -> None:
    """Author the lower levels of a face over an override layer, which stays at the finest level.

    :param levels: of each level, and of each mesh of the face, what takes its place
    """
    at, meshes = face.stage.GetPrimAtPath, [face.mesh_prim(mesh.name).GetPath() for mesh in face.meshes]
    for path in meshes:
        editable(at(path))
    materials = {label: UsdShade.Material(at(path)) for path, label in face.material_names.items()}
    variants = face.material_variants
    bindings = Bindings(face.where, materials, variants.of_materials(face.where, face.material_names))
    levels_of = face.prim.GetVariantSets().AddVariantSet(tokens.LEVELS)
    names = [f"{tokens.LEVELS}{number}" for number in range(len(levels) + 1)]
    for name in names:
        levels_of.AddVariant(name)
    for name, level in zip(names[1:], levels, strict=True):
        levels_of.SetVariantSelection(name)
        with levels_of.GetVariantEditContext():
            for path in meshes:
                at(path).SetActive(False)
            (skeleton,) = (UsdSkel.Skeleton(at(path)) for path in _paths(face, UsdSkel.Skeleton))
            taken = [str(child.GetName()) for child in face.prim.GetAllChildren()]
            children = unique_identifiers([*taken, *(f"{mesh.name}_{name}" for mesh in level)])[len(taken) :]
            # meshes are in the world, while the prims to be stand below the face
            place = UsdGeom.Xformable(face.prim).ComputeLocalToWorldTransform(Usd.TimeCode.Default())
            to_face = np.linalg.inv(matrix(place))
            for mesh, child in zip(level, children, strict=True):
                here = replace(mesh, transform=to_face @ mesh.transform)
                path = face.prim.GetPath().AppendChild(child)
                author_mesh(face.stage, path, here, skeleton, face.skeleton.joints, bindings)
    levels_of.SetVariantSelection(names[0])
    bindings.author(face.prim, variants.identifiers)


def _check(face: Face, old: FaceParts, new: FaceParts) -> None:
    """Check, before anything is authored, that what differs can be: joints for a face without, with their transforms.

    :raises TopologyError: other meshes, joints, points or faces, or not one bind and rest transform per joint
    :raises InputError: NaN, a difference in a field that stays as it is, or joint paths that are not parent first
    """
    require_writable(new, face.where)
    names = [[mesh.name for mesh in parts.meshes] for parts in (old, new)]
    if names[0] != names[1]:
        raise TopologyError(face.where, f"meshes {', '.join(names[1])}, expected {', '.join(names[0])}")
    for before, after in zip(old.meshes, new.meshes, strict=True):
        check_mesh_change(f"{face.where} -> {before.name}", before, after)
    # a face without joints may get some; other joints would leave skins and animations without theirs
    where, skeleton, joints = f"{face.where} -> {old.skeleton.name}", new.skeleton, new.skeleton.joints
    if old.skeleton.joints and old.skeleton.joints != joints:
        raise TopologyError(where, "other joints, expected those of the face")
    for name, transforms in (("bind", skeleton.bind_transforms), ("rest", skeleton.rest_transforms)):
        if np.shape(transforms) != (len(joints), 4, 4):
            raise TopologyError(where, f"{name} transforms {np.shape(transforms)}, expected one (4, 4) per joint")
    if joints and not old.skeleton.joints:
        valid, reason = UsdSkel.Topology(list(joints)).Validate()
        if not valid or len(set(joints)) != len(joints) or not all(map(Sdf.Path.IsValidPathString, joints)):
            what = f"joints that no skeleton can have, expected different paths, parents first {reason}"
            raise InputError(where, what)
    require_same(where, old.skeleton, skeleton, ("name", "transform"))
    check_sliders(face.where, new.sliders)
    check_photos(face.where, new.photos)
    check_face_network(face.where, new)
    require_same(face.where, old, new, ("name", "meters_per_unit", "up_axis", "materials"))


def _per_mesh(face: Face, name: str, values: FloatArray) -> list[FloatArray]:
    """The values of a primvar mesh by mesh.

    :raises InputError: not one for each point, or neither numbers nor NaN throughout a mesh
    """
    check_property_name(face.where, "primvar", name)
    sizes = [len(mesh.points) for mesh in face.meshes]
    if np.shape(values) != (sum(sizes),):
        raise InputError(f"{face.where} -> {name}", f"values of shape {np.shape(values)}, expected ({sum(sizes)},)")
    split = np.split(np.asarray(values), np.cumsum(sizes)[:-1])
    for mesh, own in zip(face.meshes, split, strict=True):
        if not np.isnan(own).all():
            require_float32(own, face.where, mesh.name, name)
    return split


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


def _author_skeleton_changes(prim: Usd.Prim, old: FaceParts, new: FaceParts) -> tuple[str, ...]:
    """Author on a Skeleton prim the joints, bind and rest transforms and bone limits that differ; a line for each."""
    before, after = old.skeleton, new.skeleton
    lines: tuple[str, ...] = ()
    if before.joints != after.joints:
        put(UsdSkel.Skeleton(editable(prim)).CreateJointsAttr(), list(after.joints))
        lines = (f"{after.name}: {len(after.joints)} joints",)
    if before.names != after.names:
        skeleton = UsdSkel.Skeleton(editable(prim))
        names = skeleton.CreateJointNamesAttr() if after.joint_names else skeleton.GetJointNamesAttr()
        put(names, list(after.joint_names) or None)
        lines = lines or (f"{after.name}: names of joints",)
    for name, present, transforms in (
        ("bindTransforms", before.bind_transforms, after.bind_transforms),
        ("restTransforms", before.rest_transforms, after.rest_transforms),
    ):
        if not same(present, transforms):
            put(editable(prim).GetAttribute(name), to_matrices(transforms))
            lines += (f"{after.name}: {name}",)
    if same(old.bone_limits, new.bone_limits):
        return lines
    prim = editable(prim)
    if new.bone_limits is not None:
        author_limits(prim, new.bone_limits)
    else:  # a layer over another can't take its values away, so they are blocked
        for name in (tokens.LIMITS_LOWER, tokens.LIMITS_UPPER):
            put_value(prim, name, None)
        remove_schema(prim, tokens.BONE_LIMITS_API)
    return (*lines, "bone limits")


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
    """Author on the face prim attribution, attach joint, person, VRM and recipe where they differ; a line for each."""
    lines = []
    for name, line, before, after in (
        (tokens.ATTRIBUTION, "attribution", old.attribution, new.attribution),
        (tokens.ATTACH_JOINT, "attach joint", old.attach_joint or "", new.attach_joint or ""),
        (tokens.PERSON, "person", old.person or "", new.person or ""),
        (tokens.VRM, "what VRM says of the avatar", vrm_text(old.vrm), vrm_text(new.vrm)),
    ):
        if before != after:
            put_value(prim, name, after)
            lines.append(line)
    # options are compared as the text that the stage holds, in which lists and tuples are one
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
