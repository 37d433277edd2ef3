"""Import of FBX files: meshes, skins, shapes, materials, animations, and what is lost."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.names import handles, unique_identifiers
from facepipe.core.policy.bounds import check_counts
from facepipe.declare import check_ranges
from facepipe.importers.fbx import joints as bones
from facepipe.importers.fbx import motion
from facepipe.importers.fbx.joints import Joints, Nodes
from facepipe.importers.fbx.materials import material_names, read_materials
from facepipe.importers.fbx.meshes import FIRST_UV_SET, channels_of, read_mesh, read_shapes
from facepipe.importers.fbx.motion import Track
from facepipe.importers.fbx.scene import NONE, Scene, open_scene, turn_of
from facepipe.importers.options import FbxOptions
from facepipe.parts import FaceParts, Mesh
from facepipe.rig.binding import moved, placed
from facepipe.stage.recipes import Imported, import_recipe, with_units
from facepipe.stage.uv_transforms import with_baked_uvs

_COPIES = 4  # that what is made of a mesh takes at once, at least


def read(source: Path, options: FbxOptions) -> Imported:
    """The face in an FBX file, in the file's unit; it plays its first animation.

    Points stay the file's numbers where its axes allow that (`turn_of`), but for geometric transforms and the places
    of skinned meshes, which are baked into them. A mesh without skin below a joint follows that joint.

    :raises InputError: no FBX, or data that doesn't hold together
    """
    check_ranges(options)
    scene = open_scene(source, strict=options.strict)
    try:
        with np.errstate(all="ignore"):  # overflow in hostile values ends as infinity, which is refused below
            parts = _parts(scene, options)
            _check_finite(scene, parts)
    except MemoryError:
        raise scene.error("needs more memory than there is") from None
    parts = with_units(parts, options.meters_per_unit, options.up_axis)
    return Imported(parts=parts, warnings=tuple(scene.warnings))


def _parts(scene: Scene, options: FbxOptions) -> FaceParts:
    meters = options.meters_per_unit or float(scene.settings["unit_meters"])
    if not 1e-6 <= meters <= 1e3:
        raise scene.error(f"a unit of {meters:g} m, expected 1e-06 to 1000 (option meters_per_unit gives it)")
    turn, up_axis = turn_of(scene)
    nodes = bones.read_nodes(scene, turn)
    shown = scene.tables["meshes"][[nodes.meshes[node] for node in nodes.shown]]
    check_counts(scene.where, {"Mesh": len(shown), "BlendShape": int(shown["channels"]["count"].sum())})
    certain, perhaps = bones.bones_of(scene, nodes, motion.moved_nodes(scene))
    tracks = motion.read_tracks(scene, turn, certain | perhaps, options.fps)
    carried = {node for node in perhaps if any(not bones.still(one.worlds[node], nodes.worlds[node]) for one in tracks)}
    joints = bones.read_joints(scene, nodes, certain | carried, turn)
    materials = material_names(scene)
    assembly = _Assembly(scene, nodes, joints, materials, _shape_names(scene, nodes, tracks))
    meshes = assembly.meshes()
    if not meshes:
        raise scene.error("no mesh with polygons, expected one")
    bound = {name for mesh in meshes for name in (mesh.material, *(faces.material for faces in mesh.material_faces))}
    check_counts(scene.where, {"Material": len(bound - {None})})
    animations = motion.animations(scene, tracks, joints, assembly.shapes)
    _note_losses(scene)
    return with_baked_uvs(
        FaceParts(
            meters_per_unit=meters,
            up_axis=up_axis,
            meshes=meshes,
            skeleton=joints.skeleton,
            animations=animations,
            played=next((one.name for one in animations if one.times is not None), None),
            frames_per_second=motion.frame_rate(scene, options.fps),
            materials=read_materials(scene, materials, bound, _uv_names(scene)),
            recipe=import_recipe("fbx", {scene.path: scene.files}, options),
        )
    )


def _shape_names(scene: Scene, nodes: Nodes, tracks: list[Track]) -> dict[int, str]:
    """What the shape of every channel is called, meshes in the order that they are shown."""
    channels: dict[int, str] = {}
    for mesh in dict.fromkeys(nodes.meshes[node] for node in nodes.shown):
        own = channels_of(scene, mesh)
        channels |= dict(zip(own, handles([*own.values()], "shape"), strict=True))
    return motion.channels_apart(scene, tracks, channels)


def _uv_names(scene: Scene) -> dict[str, str]:
    """The file's names of UV sets -> those on the face; of meshes that say otherwise the first."""
    found: dict[str, str] = {}
    for row in scene.tables["meshes"]:
        own = [scene.text(one["name"]) for one in scene.uv_sets(row)]
        for name, called in zip(own, unique_identifiers([FIRST_UV_SET, *own[1:]], FIRST_UV_SET), strict=False):
            found.setdefault(name, called)
    return found


@dataclass
class _Assembly:
    """Turns nodes that show a mesh into meshes."""

    scene: Scene
    nodes: Nodes
    joints: Joints
    materials: list[str]
    shapes: dict[int, str]  # by channel

    def meshes(self) -> tuple[Mesh, ...]:
        """All meshes, depth first, called as the nodes that show them, or as themselves."""
        read = [mesh for mesh in map(self._show, self.nodes.shown) if mesh is not None]
        exact = [mesh.label or mesh.data_label or "" for mesh in read]
        return tuple(
            replace(
                mesh,
                name=name,
                label=own if own != name else None,
                data_label=mesh.data_label if mesh.data_label and mesh.data_label != own else None,
            )
            for mesh, own, name in zip(read, exact, handles(exact, "mesh"), strict=True)
        )

    def _show(self, node: int) -> Mesh | None:
        scene, nodes, number = self.scene, self.nodes, self.nodes.meshes[node]
        name = nodes.names[node]
        slots = scene.ids(scene.tables["nodes"][node]["materials"])
        mesh = read_mesh(scene, name, number, [None if one == NONE else self.materials[one] for one in slots])
        if mesh is None:
            scene.warn(name, "its mesh has no polygons: left out")
            return None
        if scene.tables["nodes"][node]["hidden"]:
            scene.warn(name, "is hidden in the file: shown here")
        shapes = read_shapes(scene, name, number, self.shapes, len(mesh.points))
        own = scene.text(scene.tables["meshes"][number]["name"])
        mesh = replace(mesh, blendshapes=shapes, label=name, data_label=own)
        scene.budget.spend(_COPIES * sum(one.nbytes for one in _arrays(mesh)), scene.error)
        skin = nodes.skins[node]
        if skin >= 0:
            if scene.tables["meshes"][number]["skins"]["count"] > 1:
                scene.warn(name, "several skins: the first is kept")
            weights = bones.read_skin(scene, name, skin, self.joints, len(mesh.points))
            return placed(replace(mesh, skin=weights), self.joints.skins[skin].geom_bind)
        matrix = nodes.worlds[node] @ nodes.geometry[node]
        joint = self.joints.holding(nodes, node)
        if joint is not None:
            world = nodes.worlds[self.joints.nodes[joint]] @ self.joints.shrink
            if abs(np.linalg.det(world)) > 1e-30:
                bind = self.joints.skeleton.bind_transforms[joint]
                carried = replace(mesh, skin=bones.rigid(len(mesh.points), joint))
                return placed(carried, bind @ np.linalg.inv(world) @ matrix)
        geometry = nodes.geometry[node]
        if np.linalg.det(geometry[:3, :3]) > 1e-30 and not np.array_equal(geometry, np.eye(4)):
            return replace(moved(mesh, geometry), transform=nodes.worlds[node])
        return replace(mesh, transform=matrix)


def _arrays(mesh: Mesh) -> list[Any]:
    """Its arrays, as many as there are."""
    arrays: list[Any] = [mesh.points, mesh.face_vertex_counts, mesh.face_vertex_indices, mesh.normals, mesh.colors]
    arrays += [array for uvs in mesh.uv_sets for array in (uvs.values, uvs.indices)]
    arrays += [] if mesh.skin is None else [mesh.skin.joint_weights, mesh.skin.geom_bind_transform]
    for shape in mesh.blendshapes:
        arrays += [array for _, _, one in shape.sculpts for array in (one.offsets, one.normal_offsets)]
    return [array for array in arrays if array is not None]


def _check_finite(scene: Scene, parts: FaceParts) -> None:
    """:raises InputError: NaN or infinity in what was made of the file"""
    skeleton = parts.skeleton
    named: list[tuple[str, list[FloatArray | None]]] = [
        ("its joints", [skeleton.bind_transforms, skeleton.rest_transforms])
    ]
    named += [(mesh.name, [*_arrays(mesh), mesh.transform]) for mesh in parts.meshes]
    named += [(one.name, [one.translations, one.rotations, one.scales, one.shape_weights]) for one in parts.animations]
    for name, arrays in named:
        if not all(array is None or np.isfinite(array).all() for array in arrays):
            raise InputError(f"{scene.where} -> {ascii(name)[1:-1][:80]}", "values that are not finite")


def _note_losses(scene: Scene) -> None:
    """Warn of what a face has no place for."""
    lost = {"light": "lights", "camera": "cameras", "constraint": "constraints", "geometry cache": "caches"}
    for what, key in lost.items():
        count = int(scene.settings[key])
        if count:
            scene.warn("", f"{count} {what}{'s' * (count > 1)} left out")
