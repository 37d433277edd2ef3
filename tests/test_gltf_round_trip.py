"""What the exporter writes, the importer brings back: points, shapes with inbetweens, joints, weights, poses, UVs."""

from __future__ import annotations

from collections import Counter
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from facepipe_gltf import Options, save, write
from faces import tiny_face

from facepipe import sample
from facepipe.geometry.polygons import triangulate
from facepipe.importers import gltf
from facepipe.parts import FaceParts, FloatArray, IntArray, Mesh
from facepipe.rig import build, rest_coefficients

FACES = ("tiny", "sample")


@cache
def face(name: str) -> FaceParts:
    return tiny_face() if name == "tiny" else sample.make()


def there_and_back(parts: FaceParts, path: Path, options: Options | None = None) -> FaceParts:
    save(write(parts, options or Options(influences=8, animations=True)), path)
    return gltf.read(path, gltf.Options()).parts


@pytest.mark.parametrize("name", FACES)
@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
def test_poses_and_shapes_deform_the_same_points(name: str, suffix: str, tmp_path: Path) -> None:
    before = face(name)
    after = there_and_back(before, tmp_path / f"face{suffix}")
    unit = before.meters_per_unit
    assert after.skeleton.joints == before.skeleton.joints
    assert [mesh.name for mesh in after.meshes] == [mesh.name for mesh in before.meshes]
    one, other = build(before), build(after)
    assert other.shapes == one.shapes
    height = float(np.ptp(one.points[:, 1])) * unit
    generator = np.random.default_rng(0)
    for _ in range(10):
        weights = {shape: float(generator.uniform(-0.2, 1.2)) for shape in one.shapes}
        metres = rest_coefficients(len(one.joints)) + generator.normal(size=(len(one.joints), 9)) * 0.02
        own = metres.copy()
        own[:, :3] /= unit
        expected = one.evaluate(weights, coefficients=own) * unit
        assert np.abs(other.evaluate(weights, coefficients=metres) - expected).max() < 1e-5 * height


@pytest.mark.parametrize("name", FACES)
def test_surface_comes_back_triangulated(name: str, tmp_path: Path) -> None:
    before = face(name)
    after = there_and_back(before, tmp_path / "face.glb")
    for old, new in zip(before.meshes, after.meshes, strict=True):
        (triangles, uvs), (triangles_back, uvs_back) = surface(old), surface(new)
        assert np.array_equal(triangles, triangles_back)
        assert len(uvs) == len(uvs_back)
        for one, other in zip(uvs, uvs_back, strict=True):
            assert np.abs(one - other).max() < 1e-6


def surface(mesh: Mesh) -> tuple[IntArray, list[FloatArray]]:
    """Triangles (t, 3) of points in a canonical order, their sides kept, and the UVs (t, 3, 2) of their corners."""
    corners = triangulate(mesh.face_vertex_counts).corners
    points = mesh.face_vertex_indices[corners]
    turn = (np.argmin(points, axis=1)[:, None] + np.arange(3)) % 3
    points, corners = np.take_along_axis(points, turn, axis=1), np.take_along_axis(corners, turn, axis=1)
    order = np.lexsort(points.T)
    uvs = [
        uv_set.values[(mesh.face_vertex_indices if uv_set.indices is None else uv_set.indices)[corners[order]]]
        for uv_set in mesh.uv_sets
    ]
    return points[order], uvs


def test_animations_and_materials_come_back(tmp_path: Path) -> None:
    before = face("sample")
    after = there_and_back(before, tmp_path / "face.glb")
    assert [animation.name for animation in after.animations] == [animation.name for animation in before.animations]
    materials = {material.name: material for material in after.materials}
    assert sorted(materials) == sorted(material.name for material in before.materials)
    for old in before.materials:
        new = materials[old.name]
        if isinstance(old.diffuse_color, tuple):
            assert np.allclose(np.array(new.diffuse_color), old.diffuse_color, atol=1e-6)
    for old_mesh, new_mesh in zip(before.meshes, after.meshes, strict=True):
        assert triangles_of(new_mesh) == triangles_of(old_mesh)


def triangles_of(mesh: Mesh) -> dict[str | None, int]:
    """How many triangles show each material."""
    material = np.full(len(mesh.face_vertex_counts), mesh.material, object)
    for one in mesh.material_faces:
        material[one.faces] = one.material
    return dict(Counter(material[triangulate(mesh.face_vertex_counts).faces]))


@pytest.mark.parametrize("name", FACES)
def test_second_trip_changes_nothing(name: str, tmp_path: Path) -> None:
    once = there_and_back(face(name), tmp_path / "once.glb")
    twice = there_and_back(once, tmp_path / "twice.glb")
    for one, other in zip(once.meshes, twice.meshes, strict=True):
        assert np.array_equal(one.points, other.points)
        assert np.array_equal(surface(one)[0], surface(other)[0])
        for shape, again in zip(one.blendshapes, other.blendshapes, strict=True):
            assert np.array_equal(shape.point_indices, again.point_indices)
            assert np.array_equal(shape.offsets, again.offsets)
            assert [x.weight for x in shape.inbetweens] == [x.weight for x in again.inbetweens]


def test_quantised_export_stays_within_its_own_error(tmp_path: Path) -> None:
    before = face("sample")
    document = write(before, Options(influences=8, quantize=True))
    save(document, tmp_path / "face.glb")
    one, other = build(before), build(gltf.read(tmp_path / "face.glb", gltf.Options()).parts)
    assert document.error_mm is not None
    for weights in ({}, dict.fromkeys(one.shapes[:3], 0.7)):
        apart = np.linalg.norm(one.evaluate(weights) * before.meters_per_unit - other.evaluate(weights), axis=1)
        assert apart.max() * 1000 <= 2 * document.error_mm + 1e-3
