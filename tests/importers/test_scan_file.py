"""Scans from files: the same surface from every format, known values, and refusals in one line."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gltf_builder import Builder
from hypothesis import given, settings
from hypothesis import strategies as st
from import_data import damaged, refused, shared
from scan_files import CUBE, PAINT, SIDES, cube, read, volume
from solids import ball

from facepipe.core.errors import InputError
from facepipe.geometry.polygons import edges, merge_points
from facepipe.importers.scan_file import read_scan
from facepipe.importers.scan_ply import write_ply
from facepipe.parts import FaceParts, Mesh
from facepipe.scans import Scan
from facepipe.stage import save_parts


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize(("position", "color", "corner", "count"), [
    ("float", "uchar", "int", "uchar"), ("double", "float", "uint", "int"), ("float", "ushort", "short", "ushort"),
])  # fmt: skip
def test_every_encoding_of_a_ply_is_the_same_cube(
    form: str, position: str, color: str, corner: str, count: str, tmp_path: Path
) -> None:
    scan = read(cube(form, position, color, corner=corner, count=count), tmp_path)
    assert (scan.points == CUBE).all()
    assert len(scan.triangles) == 12
    assert volume(scan.points, scan.triangles) == pytest.approx(1.0)
    assert scan.colors is not None
    encoded = np.where(scan.colors <= 0.0031308, 12.92 * scan.colors, 1.055 * scan.colors ** (1 / 2.4) - 0.055)
    assert np.abs(encoded * 255 - PAINT).max() < 0.01


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_faces_of_mixed_size_are_fans(form: str, tmp_path: Path) -> None:
    mixed = [[0, 1, 3], [0, 3, 2], *SIDES[1:]]
    scan = read(cube(form, faces=mixed), tmp_path)
    assert volume(scan.points, scan.triangles) == pytest.approx(1.0)


@pytest.mark.parametrize("line", ["\r\n", "\r"])
def test_headers_end_lines_in_any_way(line: str, tmp_path: Path) -> None:
    head, body = cube("binary_little_endian").split(b"end_header\n")
    data = head.replace(b"\n", line.encode()) + b"end_header" + line.encode() + body
    scan = read(data, tmp_path)
    assert volume(scan.points, scan.triangles) == pytest.approx(1.0)


def test_a_written_ply_reads_back_and_has_the_same_bytes(tmp_path: Path) -> None:
    points, triangles = ball(20, 83.0)
    colors = np.abs(points) / 83.0
    scan = Scan(name="ball", points=points, triangles=triangles, normals=points / 83.0, colors=colors)
    for name in ("ball.ply", "again.ply"):
        write_ply(scan, tmp_path / name)
    assert (tmp_path / "ball.ply").read_bytes() == (tmp_path / "again.ply").read_bytes()
    back = read_scan(tmp_path / "ball.ply")
    assert (back.points == points.astype(np.float32)).all()
    assert (back.triangles == triangles).all()
    assert back.normals is not None
    assert back.colors is not None
    assert np.abs(back.normals - points / 83.0).max() < 1e-6
    assert np.abs(back.colors - colors).max() < 0.006  # 8 bits of sRGB


def test_a_cloud_stays_a_cloud(tmp_path: Path) -> None:
    points, _ = ball(9)
    write_ply(Scan(name="cloud", points=points), tmp_path / "cloud.ply")
    back = read_scan(tmp_path / "cloud.ply")
    assert back.is_cloud
    assert back.normals is None
    assert back.colors is None
    text = "".join(f"v {x} {y} {z}\n" for x, y, z in points)
    assert (read(text.encode(), tmp_path, "cloud.obj").points == points).all()


def test_nothing_that_is_not_finite_is_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="finite"):
        write_ply(Scan(name="far", points=np.array([[0.0, 0.0, 1e300]])), tmp_path / "far.ply")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("change", "message"), [
    (lambda data: data[:-30], "face: cut short"),
    (lambda data: data[: data.index(b"end_header") + 40], "vertex: cut short"),
    (lambda data: data.replace(b"vertex 8", b"vertex 8000000000"), "cut short"),
    (lambda data: data.replace(b"uchar int vertex", b"uchar quad vertex"), "expected a type and a name"),
    (lambda data: data.replace(b"binary_little_endian", b"binary_middle"), "expected a line of a PLY header"),
    (lambda data: data.replace(b"end_header", b"end-header"), "no PLY header"),
    (lambda data: data.replace(b"property float z", b"property float w"), "lacks x, y or z"),
    (lambda data: data.replace(b"element vertex", b"element points"), "no vertices"),
    (lambda data: data.replace(struct.pack("<i", 7), struct.pack("<i", 8)), "vertex 8, expected 0 to 7"),
    (lambda data: data.replace(struct.pack("<f", 1.0), struct.pack("<f", np.nan)), "NaN"),
])  # fmt: skip
def test_broken_plys_are_one_line(change: Any, message: str, tmp_path: Path) -> None:
    whole = cube("binary_little_endian")
    data = change(whole)
    assert data != whole
    error = refused(lambda: read(data, tmp_path), tmp_path / "scan.ply")
    assert error is not None
    assert message in str(error)


@settings(max_examples=150, deadline=None)
@given(data=st.one_of([damaged(cube(form)) for form in ("ascii", "binary_little_endian", "binary_big_endian")]))
def test_damaged_plys_read_finite_or_are_refused(data: bytes, tmp_path_factory: pytest.TempPathFactory) -> None:
    folder = tmp_path_factory.getbasetemp()
    found: list[Scan] = []
    refused(lambda: found.append(read(data, folder, "damaged.ply")), folder / "damaged.ply")
    for scan in found:
        assert np.isfinite(scan.points).all()
        assert scan.colors is None or ((scan.colors >= 0) & (scan.colors <= 1)).all()
        assert scan.is_cloud or (0 <= scan.triangles.min() <= scan.triangles.max() < len(scan.points))


@pytest.mark.parametrize("top", [1.0, 255.0])
def test_colours_after_the_points_of_an_obj_count(top: float, tmp_path: Path) -> None:
    rows = [" ".join(map(str, [*point, *(paint / 255 * top)])) for point, paint in zip(CUBE, PAINT, strict=True)]
    faces = "".join(f"f {' '.join(str(one + 1) for one in side)}\n" for side in SIDES)
    scan = read(("".join(f"v {row}\n" for row in rows) + faces).encode(), tmp_path, "cube.obj")
    direct = read(cube(), tmp_path)
    assert scan.colors is not None
    assert direct.colors is not None
    assert np.abs(scan.colors - direct.colors).max() < 1e-6


def test_an_obj_takes_colours_from_its_texture(tmp_path: Path) -> None:
    """Left half of the picture red, right half blue; points take what their UV shows, v up."""
    from PIL import Image

    pixels = np.zeros((16, 16, 3), np.uint8)
    pixels[:, :8, 0] = pixels[:, 8:, 2] = 255
    pixels[:8, :, 1] = 188  # of half brightness in linear light: the upper half
    Image.fromarray(pixels).save(tmp_path / "skin.png")
    (tmp_path / "face.mtl").write_text("newmtl skin\nmap_Kd skin.png\n")
    text = "mtllib face.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt .2 .2\nvt .8 .2\nvt .8 .8\nvt .2 .8\nusemtl skin\n"
    scan = read((text + "f 1/1 2/2 3/3 4/4\n").encode(), tmp_path, "face.obj")
    assert scan.colors is not None
    assert np.allclose(scan.colors, [[1, 0, 0], [0, 0, 1], [0, 0.503, 1], [1, 0.503, 0]], atol=0.01)


def two_halves() -> bytes:
    """A ball cut at its equator with doubled points there: its halves in nodes, one of them mirrored."""
    points, triangles = ball(12)
    upper = triangles[points[triangles].mean(axis=1)[:, 2] > 0]
    builder = Builder()
    primitive = {"attributes": {"POSITION": builder.array(points)}, "indices": builder.array(upper.ravel(), "u4")}
    mesh = builder.add("meshes", {"primitives": [primitive]})
    builder.add("nodes", {"mesh": mesh, "scale": [2, 2, 2], "translation": [5, 6, 7]})
    builder.add("nodes", {"mesh": mesh, "scale": [2, 2, -2], "translation": [5, 6, 7]})
    builder.add("scenes", {"nodes": [0, 1]})
    return builder.glb()


def test_nodes_of_a_glb_are_placed_and_its_seams_closed(tmp_path: Path) -> None:
    scan = read(two_halves(), tmp_path, "ball.glb")
    radii = np.linalg.norm(scan.points - [5, 6, 7], axis=1)
    assert np.abs(radii - 2.0).max() < 1e-5
    assert volume(scan.points, scan.triangles) == pytest.approx(4 / 3 * np.pi * 8, rel=0.03)
    assert (edges(np.full(len(scan.triangles), 3), scan.triangles.ravel())[1] == 2).all()


def test_a_stage_is_a_scan_too(tmp_path: Path) -> None:
    points, triangles = ball(6)
    counts = np.full(len(triangles), 3, np.int32)
    mesh = Mesh(name="Head", points=points, face_vertex_counts=counts, face_vertex_indices=triangles.ravel())
    save_parts(FaceParts(meshes=(mesh,)), tmp_path / "head.usda")
    scan = read_scan(tmp_path / "head.usda")
    assert np.abs(scan.points - points).max() < 1e-6
    assert volume(scan.points, scan.triangles) == pytest.approx(volume(points, triangles), rel=1e-5)


def test_the_real_scan_is_one_closed_surface() -> None:
    scan = read_scan(shared("scans/LeePerrySmith.glb"))
    assert (len(scan.points), len(scan.triangles)) == (8844, 17684)
    pairs, faces = edges(np.full(len(scan.triangles), 3), scan.triangles.ravel())
    assert (faces == 2).all()
    assert len(scan.points) - len(pairs) + len(scan.triangles) == 2  # a sphere's
    assert volume(scan.points, scan.triangles) > 0
    assert scan.colors is None  # its one plain material paints no face


@pytest.mark.parametrize("name", ["scan.stl", "absent.ply", "absent.glb", "folder.ply"])
def test_files_that_are_no_scan_are_refused(name: str, tmp_path: Path) -> None:
    (tmp_path / "scan.stl").write_bytes(b"solid")
    (tmp_path / "folder.ply").mkdir()
    assert refused(lambda: read_scan(tmp_path / name), tmp_path / name) is not None


def test_one_point_many_times_is_no_scan(tmp_path: Path) -> None:
    assert refused(lambda: read(b"v 1 2 3\n" * 9, tmp_path, "dot.obj"), tmp_path / "dot.obj") is not None


@given(st.lists(st.tuples(*[st.sampled_from([-0.0, 0.0, 1.0])] * 3), min_size=1, max_size=40))
def test_merged_points_are_the_different_ones_in_order(rows: list[tuple[float, ...]]) -> None:
    points = np.array(rows)
    first, place = merge_points(points)
    assert (points[first][place] == points).all()
    assert len(first) == len({tuple(row + 0.0) for row in points})
    assert (np.diff(first) > 0).all()
