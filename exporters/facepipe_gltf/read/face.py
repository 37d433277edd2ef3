"""Import of glTF 2.0 files (.glb, .gltf): meshes, skins, morph targets, materials, animations, and what is lost."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from facepipe.core.errors import InputError
from facepipe.core.names import handles
from facepipe.core.policy.bounds import check_counts
from facepipe.declare import check_ranges
from facepipe.parts import FaceParts, Mesh, Skin
from facepipe.rig.binding import placed
from facepipe.stage.recipes import Imported, import_recipe, with_units
from facepipe.stage.uv_transforms import with_baked_uvs
from facepipe_gltf.read import meshes, primitives
from facepipe_gltf.read.animations import nodes_apart, read_animations
from facepipe_gltf.read.document import Document, Names, Value, given_name, open_document, quote
from facepipe_gltf.read.materials import material_names, read_materials
from facepipe_gltf.read.meshes import Role
from facepipe_gltf.read.options import Options
from facepipe_gltf.read.primitives import Geometry
from facepipe_gltf.read.record import filled, read_record, resampled
from facepipe_gltf.read.skins import Joints, Nodes, read_joints, read_nodes
from facepipe_gltf.read.variants import Variants, read_variants

if TYPE_CHECKING:
    from facepipe_gltf.read.vrm import Avatar

_AVATARS = {"VRM", "VRMC_vrm", "VRMC_springBone", "VRMC_node_constraint"}  # extensions
_KINDS = ("scenes", "nodes", "meshes", "skins", "animations", "materials", "textures", "images", "samplers", "cameras")
_READ = ("facepipe", "targetNames")  # keys of extras
_NEAREST = (9728, 9984, 9986)  # texture filters
_FILTERS = ("magFilter", "minFilter")
_LISTED = 4


_COPIES = 4  # that what is made of a mesh takes at once, at least


def _arrays(mesh: Mesh) -> list[npt.NDArray[Any]]:
    """Its arrays, as many as there are."""
    arrays = [mesh.points, mesh.face_vertex_counts, mesh.face_vertex_indices, mesh.normals, mesh.colors]
    arrays += [array for uvs in mesh.uv_sets for array in (uvs.values, uvs.indices)]
    arrays += [] if mesh.skin is None else [mesh.skin.joint_indices, mesh.skin.joint_weights]
    for shape in mesh.blendshapes:
        arrays += [shape.point_indices]
        arrays += [array for _, _, sculpt in shape.sculpts for array in (sculpt.offsets, sculpt.normal_offsets)]
    return [array for array in arrays if array is not None]


@dataclass
class Assembly:
    """Turns mesh nodes into meshes; a glTF mesh shown several times is read once."""

    document: Document
    nodes: Nodes
    joints: Joints
    materials: list[str]  # by number; the last is for none
    variants: Variants
    weld: bool
    recorded: bool = False  # a file of ours: what places its meshes is in the record
    shape_names: Names = field(default_factory=Names)
    roles: dict[int, tuple[Role, ...]] = field(default_factory=dict)  # by node
    shown: list[int] = field(default_factory=list)  # nodes of `meshes`
    _built: dict[tuple[int, int], tuple[Mesh, Geometry, tuple[Role, ...], int] | None] = field(default_factory=dict)

    def meshes(self) -> tuple[Mesh, ...]:
        """All meshes of the scene, in its order."""
        document = self.document
        shown = [node for node in self.nodes.shown if self.nodes.values[node].get("mesh") is not None]
        # morph targets of a mesh that nodes share count each time, as each node's mesh is written out
        times = Counter(document.index("meshes", self.nodes.values[node].require("mesh")) for node in shown)
        targets = 0
        for number, count in times.items():
            primitives = document.entries("meshes")[number].require("primitives").items()
            targets += count * max((len(one.get_or("targets", []).items()) for one in primitives), default=0)
        check_counts(document.root.trail, {"Mesh": len(shown), "BlendShape": targets})
        read = [(node, mesh) for node, mesh in zip(shown, map(self._show, shown), strict=True) if mesh is not None]
        self.shown, meshes = [node for node, _ in read], [mesh for _, mesh in read]
        # called as the node that shows it; where that has no name, by the mesh's own
        exact = [mesh.label if mesh.label is not None else mesh.data_label for mesh in meshes]
        return tuple(
            replace(
                mesh,
                name=name,
                label=own if own != name else None,
                data_label=mesh.data_label if mesh.data_label != own else None,
            )
            for mesh, own, name in zip(meshes, exact, handles([own or "" for own in exact], "mesh"), strict=True)
        )

    def _show(self, node: int) -> Mesh | None:
        document, value = self.document, self.nodes.values[node]
        mesh_index = document.index("meshes", value.require("mesh"))
        skin_reference = value.get("skin")
        skin = -1 if skin_reference is None else document.index("skins", skin_reference)
        key = (mesh_index, skin)
        if key not in self._built:
            self._built[key] = None
            entry = document.entries("meshes")[mesh_index]
            geometry = primitives.read_geometry(document, entry, skin >= 0, self.variants)
            if geometry is not None:
                names, slots = self.shape_names, None if skin < 0 else self.joints.skins[skin].slots
                mesh = meshes.build_mesh(document, geometry, names, self.weld, slots, self.materials, self.recorded)
                used = np.unique(geometry.materials[geometry.materials >= 0]).tolist()
                used += [other for number in used for other in self.variants.others(number)]
                sides = [self.variants.value(i).get_or("doubleSided", False).flag() for i in dict.fromkeys(used)]
                if len(set(sides)) > 1 and not self.recorded:
                    document.warn(geometry.value, "only some of its materials are double-sided: all of the mesh is now")
                count = len(geometry.vertices.targets)
                roles = meshes.roles(document, geometry.value, count, names) if count else ()
                size = sum(one.nbytes for one in _arrays(mesh))
                self._built[key] = replace(mesh, double_sided=any(sides)), geometry, roles, size
        built = self._built[key]
        if built is None:
            document.warn(value, "its mesh has no triangles: left out")
            return None
        mesh, geometry, roles, size = built
        document.budget.spend(_COPIES * size, value.error)  # of a mesh shown again too: each is written out
        if roles:
            self.roles[node] = roles
        named = replace(mesh, label=given_name(value), data_label=given_name(geometry.value))
        if self.recorded:
            return named
        if skin >= 0:
            return placed(named, self.joints.skins[skin].geom_bind)
        # without a skin: carried by the joint that it hangs on, or placed once and for all
        held = self.joints.holding(self.nodes, node)
        if held is None:
            return replace(named, transform=self.nodes.worlds[node])
        joint, to_joint = held
        count = len(mesh.points)
        document.budget.spend(64 * count, value.error)
        own = Skin(joint_indices=np.full((count, 1), joint, np.int32), joint_weights=np.ones((count, 1), np.float32))
        return placed(replace(named, skin=own), self.joints.skeleton.bind_transforms[joint] @ to_joint)


def read(source: Path, options: Options) -> Imported:
    """The face in the scene of a glTF file: metres, Y up, v up, vertices joined into points; it plays its first clip.

    Skinned meshes are brought into skeleton space; a mesh below a joint follows that joint.

    :raises InputError: not glTF 2.0, an unsupported required extension, or data that doesn't hold together
    """
    check_ranges(options)
    try:
        with np.errstate(all="ignore"):  # overflow in hostile values ends as infinity, which is refused below
            document = open_document(source, strict=options.strict)
            parts = _parts(document, source, options)
            skeleton = parts.skeleton
            if not (np.isfinite(skeleton.bind_transforms).all() and np.isfinite(skeleton.rest_transforms).all()):
                raise document.root.error("joint transforms that are not finite")
            for mesh in parts.meshes:
                matrices = [mesh.transform] if mesh.skin is None else [mesh.transform, mesh.skin.geom_bind_transform]
                if not all(np.isfinite(array).all() for array in (*_arrays(mesh), *matrices)):
                    raise InputError(f"{document.root.trail} -> {mesh.name}", "values that are not finite")
            for animation in parts.animations:
                moving = (animation.translations, animation.rotations, animation.scales, animation.shape_weights)
                if not all(array is None or np.isfinite(array).all() for array in moving):
                    raise InputError(f"{document.root.trail} -> {animation.name}", "values that are not finite")
    except MemoryError:
        raise InputError(source.name, "needs more memory than there is") from None
    parts = with_units(parts, options.meters_per_unit, options.up_axis)
    return Imported(parts=parts, warnings=tuple(document.warnings))


def _parts(document: Document, source: Path, options: Options) -> FaceParts:
    record = read_record(document) if options.weld else None
    if record is not None:
        try:
            found = _read(document, source, options, recorded=True)
            if options.fps is not None:
                record = resampled(record, found.parts)
            face = found.as_avatar(document, filled(document, record, found.parts))
            _note_losses(document, ours=True)
            recipe = import_recipe("gltf", {source: document.files}, options)
            made = None if face.recipe is None else asdict(face.recipe)
            return replace(face, recipe=replace(recipe, options={**recipe.options, "made": made}))
        except InputError as error:
            document.warn(error.where, f"{error.what}: what glTF has no place for is left out")
    found = _read(document, source, options)
    _note_losses(document, ours=False)
    return found.as_avatar(document, found.parts)


class _Found(NamedTuple):
    """What a document shows, and what it says of it as an avatar."""

    parts: FaceParts
    avatar: Avatar | None
    joints: Joints
    assembly: Assembly

    def as_avatar(self, document: Document, face: FaceParts) -> FaceParts:
        """The face, as read or from our record, with what the document says of its avatar."""
        if self.avatar is None:
            return face
        from facepipe_gltf.read.vrm import Places

        places = Places(
            joints=dict(self.joints.of_node),
            meshes={node: number for number, node in enumerate(self.assembly.shown)},
            parts=self.parts,
            roles=self.assembly.roles,
            materials=[
                [self.assembly.materials[number] for number in numbers]
                for numbers in self.assembly.variants.by_material()
            ],
            stubs=self.assembly.recorded,
        )
        return self.avatar.on(document, face, places)


def _avatar(document: Document, nodes: Nodes) -> Avatar | None:
    extensions = document.root.get_or("extensions", {}).member_names()
    used = [name.data for name in document.root.get_or("extensionsUsed", []).items()]
    if _AVATARS.isdisjoint([*extensions, *used]):
        return None
    from facepipe_gltf.read.vrm import read_avatar  # which no other file needs

    return read_avatar(document, nodes)


def _read(document: Document, source: Path, options: Options, *, recorded: bool = False) -> _Found:
    """:param recorded: leave meshes where the file has them, as our record does the rest"""
    nodes = read_nodes(document, options.scene)
    avatar = _avatar(document, nodes)
    joints = read_joints(document, nodes, () if avatar is None or recorded else tuple(avatar.joints))
    variants = read_variants(document)
    materials = material_names(document, variants)
    assembly = Assembly(document, nodes, joints, materials, variants, options.weld, recorded)
    meshes = assembly.meshes()
    if not meshes:
        raise document.root.error("no mesh with triangles in the scene")
    shown = set(nodes.shown)
    hidden = sum(value.get("mesh") is not None for i, value in enumerate(nodes.values) if i not in shown)
    if hidden:
        document.warn(document.root, f"{hidden} nodes with a mesh are not in the scene: left out")
    if not recorded:
        meshes = _shapes_apart(document, nodes, joints, assembly, meshes)
    animations, rate = read_animations(document, nodes, joints, assembly.roles, options.fps)
    names = [name for mesh in meshes for name in (mesh.material, *(faces.material for faces in mesh.material_faces))]
    number_of = {name: number for number, name in enumerate(materials)}
    bound = [number_of[name] for name in names if name is not None]
    variants.note(bound, len(names), ours=recorded)
    parts = FaceParts(
        meters_per_unit=1.0,
        up_axis="Y",
        meshes=meshes,
        skeleton=joints.skeleton,
        animations=animations,
        played=next((one.name for one in animations if one.times is not None), None),  # a pose has none
        frames_per_second=rate,
        materials=read_materials(document, materials, bound, variants),
        attribution=" ".join(document.root.require("asset").get_or("copyright", "").text().split()),
        recipe=import_recipe("gltf", {source: document.files}, options),
    )
    return _Found(parts if recorded else with_baked_uvs(parts), avatar, joints, assembly)


def _shapes_apart(
    document: Document, nodes: Nodes, joints: Joints, assembly: Assembly, meshes: tuple[Mesh, ...]
) -> tuple[Mesh, ...]:
    """The meshes, shapes called otherwise where animations play them otherwise than those of an earlier mesh."""
    changed = list(meshes)
    for node, names in nodes_apart(document, nodes, joints, assembly.roles).items():
        called = {name: assembly.shape_names.new(name) for name in names}
        roles = assembly.roles[node]
        assembly.roles[node] = tuple(
            replace(role, shape=called.get(role.shape, role.shape), label=None) for role in roles
        )
        number = assembly.shown.index(node)
        shapes = [
            replace(shape, name=called[shape.name], label=None) if shape.name in called else shape
            for shape in changed[number].blendshapes
        ]
        changed[number] = replace(changed[number], blendshapes=tuple(shapes))
        listed = ", ".join(f"{old} is {new}" for old, new in [*called.items()][:_LISTED])
        document.warn(nodes.values[node], f"shows {len(called)} shapes otherwise than an earlier node: {listed}")
    return tuple(changed)


def _note_losses(document: Document, *, ours: bool) -> None:
    """Warn of extras, tangents, cameras and the like that the document has.

    :param ours: facepipe wrote it, so that exports compute its tangents anew
    """
    for kind in _KINDS:
        _note_extras(document, kind, document.entries(kind))
    primitives = [member for mesh in document.entries("meshes") for member in mesh.get_or("primitives", []).items()]
    _note_extras(document, "primitives", primitives)
    if not ours:
        tangents = sum(one.require("attributes").get("TANGENT") is not None for one in primitives)
        if tangents:
            what = f"TANGENT of {_counted(tangents, 'primitive')}"
            document.warn(document.root, f"{what} left out: exports compute it where a normal map needs it")
        targets = [target for one in primitives for target in one.get_or("targets", []).items()]
        turned = sum(target.get("TANGENT") is not None for target in targets)
        if turned:
            document.warn(document.root, f"tangents of {_counted(turned, 'morph target')} left out")
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
        found = value.get("extras")
        if found is None:
            continue
        if isinstance(found.data, dict):
            unread = [quote(key) for key in found.member_names() if key not in _READ]
        else:
            unread = [type(found.data).__name__]
        owners += bool(unread)
        keys.update(dict.fromkeys(unread))
    if owners:
        listed = ", ".join([*list(keys)[:_LISTED], *(["..."] if len(keys) > _LISTED else [])])
        what = kind if owners > 1 else kind.removesuffix("s") if kind != "meshes" else "mesh"
        document.warn(document.root, f"extras of {owners} {what} ({listed}) left out")


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'s' * (count > 1)}"
