"""Import of glTF 2.0 files (.glb, .gltf): meshes, skins, morph targets, materials, animations, and what is lost."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from facepipe.core.errors import InputError
from facepipe.declare import check_ranges
from facepipe.parts import FaceParts, Mesh
from facepipe.stage.imported import Imported, import_recipe, with_units
from facepipe_gltf.read.animations import read_animations
from facepipe_gltf.read.assemble import Assembly
from facepipe_gltf.read.document import Document, open_document
from facepipe_gltf.read.materials import material_names, read_materials
from facepipe_gltf.read.nodes import Nodes, read_nodes
from facepipe_gltf.read.options import Options
from facepipe_gltf.read.record import filled, read_record, resampled
from facepipe_gltf.read.skins import read_joints
from facepipe_gltf.read.values import Value, quote

_KINDS = ("scenes", "nodes", "meshes", "skins", "animations", "materials", "textures", "images", "samplers", "cameras")
_READ = ("facepipe", "targetNames")  # keys of extras
_NEAREST = (9728, 9984, 9986)  # texture filters
_FILTERS = ("magFilter", "minFilter")
_LISTED = 4


def read(source: Path, options: Options) -> Imported:
    """The face in the scene of a glTF file: metres, Y up, v up, vertices joined into points; it plays its first clip.

    Skinned meshes are brought into skeleton space; a mesh below a joint follows that joint.

    :raises InputError: not glTF 2.0, an unsupported required extension, or data that doesn't hold together
    """
    check_ranges(options)
    try:
        with np.errstate(all="ignore"):  # overflow in hostile values ends as infinity, which `_check_finite` refuses
            document = open_document(source)
            parts = _parts(document, source, options)
            _check_finite(document, parts)
    except MemoryError:
        raise InputError(source.name, "needs more memory than there is") from None
    parts = with_units(parts, options.meters_per_unit, options.up_axis)
    return Imported(parts=parts, warnings=tuple(document.warnings))


def _parts(document: Document, source: Path, options: Options) -> FaceParts:
    record = read_record(document) if options.weld else None
    if record is not None:
        try:
            read = _read(document, source, options, recorded=True)
            if options.fps is not None:
                record = resampled(record, read)
            face = filled(document, record, read)
            _note_losses(document, ours=True)
            return _with_recipe(face, document, source, options)
        except InputError as error:
            document.warn(error.where, f"{error.what}: what glTF has no place for is left out")
    face = _read(document, source, options)
    _note_losses(document, ours=False)
    return face


def _with_recipe(face: FaceParts, document: Document, source: Path, options: Options) -> FaceParts:
    """The face with the recipe of an import, which keeps the recipe from before the export."""
    recipe = import_recipe("gltf", {source: document.files}, options)
    made = None if face.recipe is None else asdict(face.recipe)
    return replace(face, recipe=replace(recipe, options={**recipe.options, "made": made}))


def _read(document: Document, source: Path, options: Options, *, recorded: bool = False) -> FaceParts:
    """:param recorded: leave meshes where the file has them, as our record does the rest"""
    nodes = read_nodes(document, options.scene)
    joints = read_joints(document, nodes)
    materials = material_names(document)  # the last stands for none
    assembly = Assembly(document, nodes, joints, materials, options.weld, recorded)
    meshes = assembly.meshes()
    if not meshes:
        raise document.root.error("no mesh with triangles in the scene")
    _note_hidden(document, nodes)
    animations = read_animations(document, nodes, joints, assembly.roles, options.fps)
    return FaceParts(
        meters_per_unit=1.0,
        up_axis="Y",
        meshes=meshes,
        skeleton=joints.skeleton,
        animations=animations.all,
        played=animations.first_clip,
        frames_per_second=animations.frames_per_second,
        materials=read_materials(document, materials, _bound(meshes)),
        attribution=" ".join(document.root.require("asset").get_or("copyright", "").text().split()),
        recipe=import_recipe("gltf", {source: document.files}, options),
    )


def _bound(meshes: tuple[Mesh, ...]) -> Iterator[str]:
    for mesh in meshes:
        if mesh.material is not None:
            yield mesh.material
        yield from (faces.material for faces in mesh.material_faces)


def _note_hidden(document: Document, nodes: Nodes) -> None:
    shown = set(nodes.shown)
    hidden = sum(value.get("mesh") is not None for i, value in enumerate(nodes.values) if i not in shown)
    if hidden:
        document.warn(document.root, f"{hidden} nodes with a mesh are not in the scene: left out")


def _check_finite(document: Document, parts: FaceParts) -> None:
    skeleton = parts.skeleton
    if not (np.isfinite(skeleton.bind_transforms).all() and np.isfinite(skeleton.rest_transforms).all()):
        raise document.root.error("joint transforms that are not finite")
    for mesh in parts.meshes:
        arrays = [mesh.points, mesh.transform, mesh.normals, mesh.colors, *(uvs.values for uvs in mesh.uv_sets)]
        arrays += [mesh.skin.joint_weights, mesh.skin.geom_bind_transform] if mesh.skin is not None else []
        for shape in mesh.blendshapes:
            arrays += [array for _, _, sculpt in shape.sculpts for array in (sculpt.offsets, sculpt.normal_offsets)]
        if not all(array is None or np.isfinite(array).all() for array in arrays):
            raise InputError(f"{document.root.trail} -> {mesh.name}", "values that are not finite")
    for animation in parts.animations:
        moving = (animation.translations, animation.rotations, animation.scales, animation.shape_weights)
        if not all(array is None or np.isfinite(array).all() for array in moving):
            raise InputError(f"{document.root.trail} -> {animation.name}", "values that are not finite")


def _note_losses(document: Document, *, ours: bool) -> None:
    """Warn of extras, tangents, cameras and the like that the document has.

    :param ours: facepipe wrote it, so that exports compute its tangents anew
    """
    for kind in _KINDS:
        _note_extras(document, kind, document.entries(kind))
    primitives = [member for mesh in document.entries("meshes") for member in mesh.get_or("primitives", []).items()]
    _note_extras(document, "primitives", primitives)
    if not ours:
        _note_tangents(document, primitives)
    cameras = len(document.entries("cameras"))
    if cameras:
        document.warn(document.root, f"{_counted(cameras, 'camera')} left out")
    sharp = sum(
        any(entry.get_or(key, None).data in _NEAREST for key in _FILTERS) for entry in document.entries("samplers")
    )
    if sharp:
        document.warn(document.root, f"{_counted(sharp, 'nearest texel filter')} left out: USD has none")


def _note_extras(document: Document, kind: str, values: Sequence[Value]) -> None:
    keys: dict[str, None] = {}
    owners = 0
    for value in values:
        unread = list(_extras(value))
        owners += bool(unread)
        keys.update(dict.fromkeys(unread))
    if owners:
        listed = ", ".join([*list(keys)[:_LISTED], *(["..."] if len(keys) > _LISTED else [])])
        what = kind if owners > 1 else kind.removesuffix("s") if kind != "meshes" else "mesh"
        document.warn(document.root, f"extras of {owners} {what} ({listed}) left out")


def _extras(value: Value) -> Iterator[str]:
    """Keys of an object's extras that nothing reads; extras that are no object as what they are."""
    extras = value.get("extras")
    if extras is None:
        return
    if isinstance(extras.data, dict):
        yield from (quote(key) for key in extras.member_names() if key not in _READ)
    else:
        yield type(extras.data).__name__


def _note_tangents(document: Document, primitives: Sequence[Value]) -> None:
    tangents = sum(primitive.require("attributes").get("TANGENT") is not None for primitive in primitives)
    if tangents:
        document.warn(
            document.root,
            f"TANGENT of {_counted(tangents, 'primitive')} left out: exports compute it where a normal map needs it",
        )
    morphs = sum(
        target.get("TANGENT") is not None
        for primitive in primitives
        for target in primitive.get_or("targets", []).items()
    )
    if morphs:
        document.warn(document.root, f"tangents of {_counted(morphs, 'morph target')} left out")


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'s' * (count > 1)}"
