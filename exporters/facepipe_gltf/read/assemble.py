"""Meshes of a document where its nodes show them: skinned, carried by a joint, or placed by a transform."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.names import handles
from facepipe.core.policy.bounds import check_counts
from facepipe.geometry.vectors import transformed, unit_vectors
from facepipe.parts import Mesh, Skin, identity
from facepipe_gltf.read import materials, meshes, morphs, primitives
from facepipe_gltf.read.document import Document
from facepipe_gltf.read.morphs import Role
from facepipe_gltf.read.names import Names, given_name
from facepipe_gltf.read.nodes import Nodes
from facepipe_gltf.read.primitives import Geometry
from facepipe_gltf.read.skins import Joints


def _placed(mesh: Mesh, matrix: FloatArray) -> Mesh:
    """A skinned `mesh` with its points moved by `matrix` (mesh space -> skeleton space at bind), so in metres.

    A matrix that mirrors or flattens would turn faces inside out: it becomes the geomBind instead.
    """
    if mesh.skin is None or np.array_equal(matrix, identity()):
        return mesh
    determinant = float(np.linalg.det(matrix[:3, :3]))
    if not 1e-30 < determinant < 1e30:
        return replace(mesh, skin=replace(mesh.skin, geom_bind_transform=matrix))
    # det(A)^(1/3) A^-T is the rotation of a scaled rotation: normal offsets are not normalised, and keep their length
    turn: FloatArray = np.linalg.inv(matrix[:3, :3]).T * np.cbrt(determinant)

    def offset(values: FloatArray) -> FloatArray:
        return (np.asarray(values, np.float64) @ matrix[:3, :3].T).astype(np.float32)

    def normal(values: FloatArray) -> FloatArray:
        return (np.asarray(values, np.float64) @ turn.T).astype(np.float32)

    return replace(
        mesh,
        points=transformed(mesh.points, matrix).astype(np.float32),
        normals=None if mesh.normals is None else unit_vectors(normal(mesh.normals)),
        blendshapes=tuple(shape.changed(offset, normal) for shape in mesh.blendshapes),
    )


_COPIES = 4  # that what is made of a mesh takes at once, at least


class _Built(NamedTuple):
    """A mesh of the document for one skin, before a node shows it."""

    mesh: Mesh
    geometry: Geometry
    roles: tuple[Role, ...]
    size: int  # bytes of its arrays


def _size(mesh: Mesh) -> int:
    arrays = [mesh.points, mesh.face_vertex_counts, mesh.face_vertex_indices, mesh.normals, mesh.colors]
    arrays += [array for uvs in mesh.uv_sets for array in (uvs.values, uvs.indices)]
    arrays += [] if mesh.skin is None else [mesh.skin.joint_indices, mesh.skin.joint_weights]
    for shape in mesh.blendshapes:
        arrays += [shape.point_indices]
        arrays += [array for _, _, sculpt in shape.sculpts for array in (sculpt.offsets, sculpt.normal_offsets)]
    return sum(array.nbytes for array in arrays if array is not None)


@dataclass
class Assembly:
    """Turns mesh nodes into meshes; a glTF mesh shown several times is read once."""

    document: Document
    nodes: Nodes
    joints: Joints
    materials: list[str]
    weld: bool
    recorded: bool = False  # a file of ours: what places its meshes is in the record
    shape_names: Names = field(default_factory=Names)
    roles: dict[int, tuple[Role, ...]] = field(default_factory=dict)  # by node
    _built: dict[tuple[int, int], _Built | None] = field(default_factory=dict)

    def meshes(self) -> tuple[Mesh, ...]:
        """All meshes of the scene, in its order."""
        shown = [node for node in self.nodes.shown if self.nodes.values[node].get("mesh") is not None]
        check_counts(self.document.root.trail, {"Mesh": len(shown), "BlendShape": self._targets(shown)})
        built = [self._show(node) for node in shown]
        meshes = [mesh for mesh in built if mesh is not None]
        names = handles([_exact(mesh) or "" for mesh in meshes], "mesh")
        return tuple(_named(mesh, name) for mesh, name in zip(meshes, names, strict=True))

    def _targets(self, shown: list[int]) -> int:
        """How many morph targets the nodes show, those of a mesh that they share each time."""
        times = Counter(self.document.index("meshes", self.nodes.values[node].require("mesh")) for node in shown)
        total = 0
        for mesh, count in times.items():
            primitives = self.document.entries("meshes")[mesh].require("primitives").items()
            total += count * max((len(one.get_or("targets", []).items()) for one in primitives), default=0)
        return total

    def _show(self, node: int) -> Mesh | None:
        document, value = self.document, self.nodes.values[node]
        mesh_index = document.index("meshes", value.require("mesh"))
        skin_reference = value.get("skin")
        skin = -1 if skin_reference is None else document.index("skins", skin_reference)
        key = (mesh_index, skin)
        if key not in self._built:
            self._built[key] = self._build(mesh_index, skin)
        built = self._built[key]
        if built is None:
            document.warn(value, "its mesh has no triangles: left out")
            return None
        mesh, geometry = built.mesh, built.geometry
        document.budget.spend(_COPIES * built.size, value.error)  # of a mesh shown again too: each is written out
        if built.roles:
            self.roles[node] = built.roles
            if any(value.get_or("weights", []).numbers()):
                document.warn(value, "default morph weights are left out: the neutral has all shapes at 0")
        named = replace(mesh, label=given_name(value), data_label=given_name(geometry.value))
        if self.recorded:
            return named
        if skin >= 0:
            return _placed(named, self.joints.skins[skin].geom_bind)
        return self._unskinned(node, named)

    def _build(self, mesh_index: int, skin: int) -> _Built | None:
        document = self.document
        geometry = primitives.read_geometry(document, document.entries("meshes")[mesh_index], skin >= 0)
        if geometry is None:
            return None
        slots = None if skin < 0 else self.joints.skins[skin].slots
        mesh = meshes.build_mesh(document, geometry, self.shape_names, self.weld, slots, self.materials, self.recorded)
        used = [number for number in np.unique(geometry.materials).tolist() if number >= 0]
        sides = [materials.is_double_sided(document, number) for number in used]
        if len(set(sides)) > 1 and not self.recorded:
            document.warn(geometry.value, "only some of its materials are double-sided: all of the mesh is now")
        count = len(geometry.vertices.targets)
        roles = morphs.roles(document, geometry.value, count, self.shape_names) if count else ()
        return _Built(replace(mesh, double_sided=any(sides)), geometry, roles, _size(mesh))

    def _unskinned(self, node: int, mesh: Mesh) -> Mesh:
        """A mesh without skin: carried by the joint it hangs on, or placed once and for all."""
        held = self.joints.holding(self.nodes, node)
        if held is None:
            return replace(mesh, transform=self.nodes.worlds[node])
        joint, to_joint = held
        count = len(mesh.points)
        self.document.budget.spend(64 * count, self.nodes.values[node].error)
        skin = Skin(joint_indices=np.full((count, 1), joint, np.int32), joint_weights=np.ones((count, 1), np.float32))
        bind = self.joints.skeleton.bind_transforms[joint]
        return _placed(replace(mesh, skin=skin), bind @ to_joint)


def _exact(mesh: Mesh) -> str | None:
    """The name of the node that shows it; where that has none, the mesh's own."""
    return mesh.label if mesh.label is not None else mesh.data_label


def _named(mesh: Mesh, name: str) -> Mesh:
    """The mesh with `name`; a label that equals it is dropped."""
    exact, data = _exact(mesh), mesh.data_label
    return replace(mesh, name=name, label=exact if exact != name else None, data_label=data if data != exact else None)
