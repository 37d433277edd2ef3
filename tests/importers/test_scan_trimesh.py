"""Scans that trimesh reads: the same surface from STL and OFF, in the file's order, and refusals in one line."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from import_data import damaged, refused, shared
from scan_files import CUBE, SIDES, read, volume

from facepipe.geometry.polygons import edges
from facepipe.importers.scan_file import read_scan
from facepipe.importers.scan_ply import write_ply
from facepipe.scans import Scan

HALVES = [half for a, b, c, d in SIDES for half in ([a, b, c], [a, c, d])]
POINTS = "".join(f"{x:g} {y:g} {z:g}\n" for x, y, z in CUBE)
QUADS = "".join(f"4 {' '.join(map(str, side))}\n" for side in SIDES)


def text_stl(*groups: list[list[int]]) -> bytes:
    """A cube's triangles by the format's description, each group a solid."""
    solids = []
    for triangles in groups:
        corners = [f"vertex {x:g} {y:g} {z:g}" for x, y, z in CUBE[np.ravel(triangles)]]
        loops = ["\n".join(["outer loop", *corners[i : i + 3], "endloop"]) for i in range(0, len(corners), 3)]
        facets = "\n".join(f"facet normal 0 0 0\n{loop}\nendfacet" for loop in loops)
        solids.append(f"solid side\n{facets}\nendsolid side\n")
    return "".join(solids).encode()


def binary_stl(header: bytes = b"made here") -> bytes:
    rows = [struct.pack("<12fH", 0, 0, 0, *CUBE[half].ravel(), 7) for half in HALVES]
    return header.ljust(80, b" ") + struct.pack("<I", len(rows)) + b"".join(rows)


FILES = {
    "text.stl": text_stl(HALVES),
    "solids.stl": text_stl(HALVES[:5], HALVES[5:]),
    "large.STL": text_stl(HALVES).upper(),
    "binary.stl": binary_stl(),
    "solid.stl": binary_stl(b"solid, it says"),
    "cube.off": f"OFF\n8 6 12\n{POINTS}{QUADS}".encode(),
    "one_line.off": f"OFF 8 6\n\n# a cube\n{POINTS}# sides\n{QUADS}".encode(),
    "colours.off": f"COFF\r\n8 6 0\n{POINTS.replace(chr(10), ' 255 0 0 255' + chr(10))}{QUADS}".encode(),
    "mixed.off": f"OFF\n8 7 0\n{POINTS}3 0 1 3 1 0 0\n3 0 3 2 1 0 0\n{QUADS.partition(chr(10))[2]}".encode(),
}


@pytest.mark.parametrize("name", FILES)
def test_every_way_of_writing_it_is_the_same_closed_cube(name: str, tmp_path: Path) -> None:
    scan = read(FILES[name], tmp_path, name)
    assert len(scan.triangles) == 12
    assert volume(scan.points, scan.triangles) == pytest.approx(1.0)
    assert (edges(np.full(12, 3), scan.triangles.ravel())[1] == 2).all()
    assert {*map(tuple, scan.points)} == {*map(tuple, CUBE)}
    if name.endswith(".off"):
        assert (scan.points == CUBE).all()


@pytest.mark.parametrize("kind", ["off", "stl", "stl_ascii", "ply"])
def test_the_real_scan_comes_back_from_what_trimesh_writes(kind: str, tmp_path: Path) -> None:
    scan = read_scan(shared("scans/LeePerrySmith.glb"))
    path = tmp_path / f"scan.{kind.partition('_')[0]}"
    trimesh.Trimesh(scan.points, scan.triangles, process=False).export(path, file_type=kind)
    back = read_scan(path)
    assert len(back.points) == len(scan.points)
    assert np.abs(back.points[back.triangles] - scan.points[scan.triangles]).max() < 1e-6
    if not kind.startswith("stl"):
        assert (back.triangles == scan.triangles).all()


def test_trimesh_reads_our_ply_point_by_point(tmp_path: Path) -> None:
    scan = read_scan(shared("scans/LeePerrySmith.glb"))
    low, high = scan.points.min(axis=0), scan.points.max(axis=0)
    colored = Scan(name="", points=scan.points, triangles=scan.triangles, colors=(scan.points - low) / (high - low))
    write_ply(colored, tmp_path / "scan.ply")
    own, theirs = read_scan(tmp_path / "scan.ply"), trimesh.load_mesh(tmp_path / "scan.ply", process=False)
    assert (own.points == theirs.vertices).all()
    assert (own.triangles == theirs.faces).all()
    assert own.colors is not None
    level = theirs.visual.vertex_colors[:, :3] / 255
    linear = np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)
    assert np.abs(own.colors - linear).max() < 1e-9


@pytest.mark.parametrize(("name", "old", "new", "message"), [
    ("binary.stl", struct.pack("<I", 12), struct.pack("<I", 4_000_000_000), "200000000084 for the 4000000000"),
    ("solid.stl", struct.pack("<I", 12), struct.pack("<I", 11), "cut short"),
    ("binary.stl", struct.pack("<f", 1), struct.pack("<f", np.inf), "infinity"),
    ("text.stl", b"vertex 0 0 1", b"vertex 0 zero 1", "be read"),
    ("text.stl", b"vertex 0 0 1", b"vertex 0 nan 1", "NaN"),
    ("text.stl", b"vertex 0 0 1\n", b"", "be read"),
    ("text.stl", b"endsolid", b"endless", "of 12"),
    ("text.stl", b"facet", b"face", "no triangles"),
    ("text.stl", b"solid", b"liquid", "no STL"),
    ("cube.off", b"8 6 12", b"-8 6 12", "no OFF header"),
    ("cube.off", b"OFF", b"4OFF", "no OFF header"),
    ("cube.off", b"8 6 12", b"8 9999999999 12", "cut short"),
    ("cube.off", b"8 6 12", b"7 6 12", "face 0"),
    ("cube.off", b"4 0 1 3 2", b"4 0 1 3", "11 triangles can be read of 12"),
    ("cube.off", b"4 0 1 3 2", b"4 0 1 3 8", "outside"),
    ("cube.off", b"4 0 1 3 2", b"5 0 1 3 2 2", "expected 3 or 4"),
    ("cube.off", b"0 0 1\n", b"0 0\n", "can't be read"),
    ("cube.off", b"0 0 1\n", b"0 nan 1\n", "NaN"),
    ("cube.off", b"8 6 12", b"8 0 12", "no triangles"),
    ("cube.off", b"OFF", b"OFF\0BINARY", "binary"),
    ("cube.off", FILES["cube.off"], b"# nothing", "no OFF header"),
    ("cube.off", FILES["cube.off"], b"OFF", "no OFF header"),
])  # fmt: skip
def test_broken_files_are_one_line(name: str, old: bytes, new: bytes, message: str, tmp_path: Path) -> None:
    assert old in FILES[name]
    error = refused(lambda: read(FILES[name].replace(old, new), tmp_path, name), tmp_path / name)
    assert error is not None
    assert message in str(error)


@settings(max_examples=150, deadline=None)
@given(one=st.sampled_from(sorted(FILES)).flatmap(lambda name: st.tuples(st.just(name), damaged(FILES[name]))))
def test_damaged_files_read_finite_or_are_refused(
    one: tuple[str, bytes], tmp_path_factory: pytest.TempPathFactory
) -> None:
    name, data = one
    folder = tmp_path_factory.getbasetemp()
    found: list[Scan] = []
    refused(lambda: found.append(read(data, folder, name)), folder / name)
    for scan in found:
        assert np.isfinite(scan.points).all()
        assert 0 <= scan.triangles.min() <= scan.triangles.max() < len(scan.points)
