"""A face's meshes for trimesh: surfaces to measure, cut, draw or save in its formats."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.geometry.colors import to_srgb
from facepipe.geometry.polygons import point_triangles
from facepipe.parts import Mesh, Skeleton

if TYPE_CHECKING:
    import trimesh


def scene_of(meshes: Sequence[Mesh], points: Mapping[str, FloatArray], skeleton: Skeleton) -> trimesh.Scene:
    """A scene in metres of the meshes that have faces, by name.

    :param points: mesh name -> (n, 3) world points in metres
    """
    import trimesh

    scene = trimesh.Scene()
    for mesh in meshes:
        to_world = mesh.transform if mesh.skin is None else skeleton.transform @ mesh.skin.geom_bind_transform
        triangles = point_triangles(mesh.face_vertex_counts, mesh.face_vertex_indices)
        if np.linalg.det(to_world[:3, :3]) < 0:  # a mirror turns them inside out
            triangles = triangles[:, ::-1]
        a, b, c = triangles.T
        triangles = triangles[(a != b) & (b != c) & (c != a)]
        if len(triangles):
            colors = None if mesh.colors is None else np.rint(to_srgb(mesh.colors) * 255).astype(np.uint8)
            surface = trimesh.Trimesh(points[mesh.name], triangles, vertex_colors=colors, process=False)
            scene.add_geometry(surface, geom_name=mesh.name, node_name=mesh.name)
    scene.units = "m"
    return scene
