"""A face authored from its parts."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

from pxr import Sdf, Usd, UsdGeom, UsdSkel

from facepipe.core import __version__, tokens
from facepipe.core.atomic import together
from facepipe.core.names import identifier, unique_identifiers
from facepipe.core.policy.bounds import check_counts
from facepipe.parts import FaceParts
from facepipe.stage.author_mesh import author_mesh
from facepipe.stage.files import check_suffix, new_stage, relative_path, save_layer
from facepipe.stage.material_variants import Bindings, check_variants
from facepipe.stage.materials import author_materials, textures_of
from facepipe.stage.photos import author_photo_changes, check_photos
from facepipe.stage.prims import apply_schema, put_value
from facepipe.stage.skeleton import (
    author_animation,
    author_limits,
    author_recipe,
    author_skeleton,
    author_source,
    author_time_range,
    vrm_text,
)
from facepipe.stage.sliders import (
    author_person_basis,
    author_slider_network,
    author_sliders,
    check_face_network,
    check_sliders,
)
from facepipe.stage.textures import TextureFolder, texture_home
from facepipe.stage.values import require_writable


def save_parts(parts: FaceParts, path: str | os.PathLike[str]) -> None:
    """Author a face and save it, atomically; textures go to ``<stem>_textures/`` beside it, or into the .usdz.

    :raises InputError: a suffix that is not USD, a folder that can't be written, or NaN, infinity or
        numbers beyond float32 in the parts
    """
    target = Path(path)
    check_suffix(target)
    with texture_home(target) as home, together(target):
        folder = TextureFolder(home)
        textures = {name: folder.add(name, texture.image()) for name, texture in textures_of(parts).items()}
        if parts.recipe is not None:  # its sources as seen from the folder of the face, where they are files
            sources = tuple(
                relative_path(source, target.parent) if Path(source).exists() else source
                for source in parts.recipe.sources
            )
            parts = replace(parts, recipe=replace(parts.recipe, sources=sources))
        stage = author(parts, textures)  # the stage keeps its layer alive
        folder.write()
        save_layer(stage.GetRootLayer(), target, beside=home.parent)


def author(parts: FaceParts, textures: dict[str, str] | None = None) -> Usd.Stage:
    """A stage in memory that holds the face as its default prim.

    :param textures: asset path by texture name; names themselves where not given
    """
    # what our own reader would refuse is not written
    counts = {
        "Mesh": len(parts.meshes),
        "BlendShape": sum(len(mesh.blendshapes) for mesh in parts.meshes),
        "GeomSubset": sum(len(mesh.material_faces) + len(mesh.point_subsets) for mesh in parts.meshes),
        "Material": len(parts.materials),
        "Shader": sum(1 + 2 * len(material.textured) for material in parts.materials),
    }
    check_counts(parts.name, counts)
    check_variants(parts.name, len(parts.variants), sum(1 + len(mesh.material_faces) for mesh in parts.meshes))
    require_writable(parts, parts.name)
    stage = new_stage(parts.meters_per_unit, parts.up_axis, parts.frames_per_second)
    path = UsdSkel.Root.Define(stage, f"/{identifier(parts.name)}").GetPath()
    prim = stage.GetPrimAtPath(path)
    stage.SetDefaultPrim(prim)
    apply_schema(prim, tokens.FACE_API)
    for name, value in (
        (tokens.ATTRIBUTION, parts.attribution),
        (tokens.ATTACH_JOINT, parts.attach_joint),
        (tokens.PERSON, parts.person),
        (tokens.VRM, vrm_text(parts.vrm)),
        (tokens.VERSION, __version__),
    ):
        if value:
            put_value(prim, name, value)
    if parts.person_basis is not None:
        author_person_basis(prim, parts.person_basis)
    check_photos(parts.name, parts.photos)
    skeleton = author_skeleton(stage, path.AppendChild(identifier(parts.skeleton.name)), parts.skeleton)
    if parts.bone_limits:
        author_limits(skeleton.GetPrim(), parts.bone_limits)
    bindings = _materials(stage, path.AppendChild(tokens.MATERIALS_SCOPE), parts, textures or {})
    taken = [parts.skeleton.name, tokens.MATERIALS_SCOPE, tokens.ANIMATIONS_SCOPE]
    taken += [tokens.PHOTOS_SCOPE] if parts.photos else []
    # a mesh called like the Skeleton or a scope would be defined as that very prim
    names = unique_identifiers([*taken, *(mesh.name for mesh in parts.meshes)])[len(taken) :]
    for mesh, name in zip(parts.meshes, names, strict=True):
        author_mesh(stage, path.AppendChild(name), mesh, skeleton, parts.skeleton.joints, bindings)
    bindings.author(prim)
    if parts.animations:
        scope = path.AppendChild(tokens.ANIMATIONS_SCOPE)
        UsdGeom.Scope.Define(stage, scope)
        names = unique_identifiers(animation.name for animation in parts.animations)
        for animation, name in zip(parts.animations, names, strict=True):
            author_animation(stage, scope.AppendChild(name), animation, parts.skeleton)
            if animation.name == parts.played:
                author_source(skeleton.GetPrim(), scope.AppendChild(name))
        author_time_range(stage, parts.animations)
    author_photo_changes(prim, (), (), parts.photos)
    check_sliders(parts.name, parts.sliders)
    check_face_network(parts.name, parts)
    author_sliders(prim, parts.sliders)
    if parts.slider_network is not None:
        author_slider_network(prim, parts.slider_network)
    if parts.recipe:
        author_recipe(prim, parts.recipe)
    return stage


def _materials(stage: Usd.Stage, scope: Sdf.Path, parts: FaceParts, textures: dict[str, str]) -> Bindings:
    """The face's materials, defined below `scope`, to be bound to its meshes."""
    materials = author_materials(stage, scope, parts.materials, textures) if parts.materials else {}
    return Bindings(parts.name, materials, {material.name: material.variants for material in parts.materials})
