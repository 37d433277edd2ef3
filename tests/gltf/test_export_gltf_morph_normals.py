"""Normals that the glTF exporter computes for blendshapes without any."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from faces import replace_mesh, tiny_face
from gltf_export import Writing, writing, written

from facepipe.parts import FaceParts, Mesh, Skin

__all__ = ["writing", "written"]


def mirrored(skin: Skin) -> Skin:
    return replace(skin, geom_bind_transform=np.diag([-1.0, 1.0, 1.0, 1.0]))


def face(*, reflected: bool) -> FaceParts:
    """A curved grid; of its two shapes the first has authored normal offsets, its inbetween none."""
    parts = tiny_face()
    head, teeth = parts.meshes
    assert head.skin is not None
    points = np.array(head.points)
    points[:, 2] = 0.2 * np.sin(points[:, 0]) * np.cos(points[:, 1])
    skin = mirrored(head.skin) if reflected else head.skin
    return replace(parts, meshes=(replace_mesh(head, points=points, skin=skin), teeth))


def surface_normals(positions: np.ndarray, points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Area-weighted unit normals per vertex, one triangle after another; vertices of one point share theirs."""
    summed: dict[int, np.ndarray] = {}
    for a, b, c in triangles:
        area = np.cross(positions[b] - positions[a], positions[c] - positions[a])
        for point in (points[a], points[b], points[c]):
            summed[point] = summed.get(point, np.zeros(3)) + area
    normals = np.stack([summed[point] for point in points])
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def by_name(mesh: Mesh) -> set[str]:
    return {shape.name for shape in mesh.blendshapes if shape.normal_offsets is not None}


@pytest.mark.parametrize("reflected", [False, True])
def test_computed_normals_are_those_of_the_moved_surface(reflected: bool, writing: Writing) -> None:
    parts = face(reflected=reflected)
    file, _ = writing(parts, morph_normals=True)
    for mesh in parts.meshes:
        primitive = file.mesh(mesh.name)["primitives"][0]
        attributes, triangles = primitive["attributes"], file.decoded(primitive["indices"]).astype(int).reshape(-1, 3)
        points = file.decoded(attributes["_FACEPIPE_POINT"]).astype(int).ravel()
        compared = 0
        for name, target in zip(file.targets(mesh.name), primitive["targets"], strict=True):
            if name in by_name(mesh):
                continue
            moved = file.decoded(attributes["POSITION"]) + file.decoded(target["POSITION"])
            found = file.decoded(attributes["NORMAL"]) + file.decoded(target["NORMAL"])
            assert np.abs(found - surface_normals(moved, points, triangles)).max() < 1e-5
            compared += 1
        assert compared


def test_authored_normal_offsets_and_all_positions_stay_as_they_are(writing: Writing) -> None:
    parts = face(reflected=False)
    plain, _ = writing(parts, "plain.glb")
    computed, _ = writing(parts, "computed.glb", morph_normals=True)
    for mesh in parts.meshes:
        before, after = (file.mesh(mesh.name)["primitives"][0]["targets"] for file in (plain, computed))
        for name, old, new in zip(plain.targets(mesh.name), before, after, strict=True):
            assert np.array_equal(plain.decoded(old["POSITION"]), computed.decoded(new["POSITION"]))
            if name in by_name(mesh):
                assert np.array_equal(plain.decoded(old["NORMAL"]), computed.decoded(new["NORMAL"]))
