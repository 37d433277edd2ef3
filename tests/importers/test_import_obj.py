"""The OBJ importer: points and faces as in the files, one shape a file, and no harm from bad ones."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from import_data import damaged, refused
from obj_files import MTL, NEUTRAL, PNG

from facepipe.core.errors import InputError, TopologyError
from facepipe.geometry.colors import to_srgb
from facepipe.importers import load
from facepipe.importers.obj import Options, read
from facepipe.importers.scan_file import read_scan
from facepipe.importers.wavefront import read_obj


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "Neutral.OBJ").write_text(NEUTRAL)
    (tmp_path / "jawOpen.obj").write_text(NEUTRAL.replace("v 1 1 0", "v 1 1 0.5"))
    (tmp_path / "eye-blink.obj").write_text(NEUTRAL.replace("v 6 1 0", "v 6 2 0").replace("\n", "\r\n"))
    (tmp_path / "face.mtl").write_text(MTL)
    (tmp_path / "maps").mkdir()
    (tmp_path / "maps" / "eye 1.png").write_bytes(PNG)
    (tmp_path / "landmarks.json").write_text(json.dumps({"multipie68": [3, 0], "eyes": {"tip": 7}}))
    return tmp_path


def test_a_folder_becomes_a_face(folder: Path) -> None:
    imported = load("obj", folder)
    assert imported.warnings == ()
    face, eye = imported.parts.meshes
    assert (face.name, eye.name) == ("Face", "Left eye")
    assert face.face_vertex_counts.tolist() == [4, 3]
    assert face.face_vertex_indices.tolist() == [0, 1, 2, 3, 1, 4, 2]
    assert eye.points.tolist() == [[5, 0, 0], [6, 0, 0], [6, 1, 0]]
    uv = face.uv_sets[0]
    assert uv.indices is not None
    assert uv.values[uv.indices].tolist() == [[0, 0], [1, 0], [1, 1], [0, 1], [0, 0], [1, 0], [1, 1]]
    assert [(s.name, s.point_indices.tolist(), s.offsets.tolist()) for s in face.blendshapes] == [
        ("jawOpen", [2], [[0, 0, 0.5]])
    ]
    assert [(s.name, s.point_indices.tolist(), s.offsets.tolist()) for s in eye.blendshapes] == [
        ("eye-blink", [2], [[0, 1, 0]])
    ]
    assert face.landmarks["multipie68"].indices.tolist() == [3, 0]
    assert (eye.landmarks["eyes"].indices.tolist(), eye.landmarks["eyes"].names) == ([2], ("tip",))
    assert (face.material_faces[0].material, eye.material_faces[0].material) == ("skin", "eye")
    skin, eye_material = imported.parts.materials
    assert (skin.diffuse_color, skin.opacity) == ((0.5, 0.25, 0.125), 0.5)
    assert not isinstance(eye_material.diffuse_color, tuple)
    assert eye_material.diffuse_color.texture.data == PNG
    assert imported.parts.recipe is not None
    assert imported.parts.recipe.verb == "import obj"


def test_the_digest_follows_every_file_that_was_read(folder: Path) -> None:
    def digest() -> str:
        recipe = load("obj", folder).parts.recipe
        assert recipe is not None
        return recipe.digests[0]

    first = digest()
    assert digest() == first
    for name in ("jawOpen.obj", "maps/eye 1.png", "face.mtl", "landmarks.json"):
        old = (folder / name).read_bytes()
        (folder / name).write_bytes(old + b"\n")
        assert digest() != first, name
        (folder / name).write_bytes(old)


def test_objects_that_share_points_stay_one_mesh(tmp_path: Path) -> None:
    (tmp_path / "neutral.obj").write_text(NEUTRAL.replace("f -3/1/1", "f 1/1/1").replace("mtllib face.mtl\n", ""))
    (mesh,) = load("obj", tmp_path).parts.meshes
    assert len(mesh.points) == 8
    assert [group.faces.tolist() for group in mesh.material_faces] == [[0, 1], [2]]


def test_a_single_file_is_a_face_without_shapes(folder: Path) -> None:
    parts = load("obj", folder / "jawOpen.obj").parts
    assert len(parts.meshes) == 2
    assert not any(mesh.blendshapes for mesh in parts.meshes)


def test_shapes_below_the_threshold_are_dropped_and_named(folder: Path) -> None:
    imported = read(folder, Options(threshold=0.6, up_axis="Z", meters_per_unit=1.0))
    assert {shape.name for mesh in imported.parts.meshes for shape in mesh.blendshapes} == {"eye-blink"}
    assert any("jawOpen" in warning for warning in imported.warnings)
    assert (imported.parts.up_axis, imported.parts.meters_per_unit) == ("Z", 1.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (NEUTRAL.replace("v 6 1 0\n", "").replace("-3/", "1/"), "7 points, expected 8"),
        (NEUTRAL.replace("f 2/1/1 5/2/1 3/3/1\n", ""), "2 faces, expected 3"),
        (NEUTRAL.replace("2/1/1 5/2/1", "5/1/1 2/2/1"), r"face 2 has points \[5, 2, 3\], expected \[2, 5, 3\]"),
    ],
)
def test_another_topology_names_file_and_difference(folder: Path, text: str, message: str) -> None:
    (folder / "bad.obj").write_text(text)
    with pytest.raises(TopologyError, match=rf"bad\.obj: {message}"):
        load("obj", folder)


@pytest.mark.parametrize(
    "name", ["../secret.png", "/etc/hostname", "maps/../../secret.png", "..\\secret.png", "link.png"]
)
@pytest.mark.parametrize("keyword", ["map_Kd", "mtllib"])
def test_nothing_outside_of_the_folder_is_read(folder: Path, name: str, keyword: str) -> None:
    inner = folder / "inner"
    inner.mkdir()
    (folder / "secret.png").write_bytes(b"secret")
    (inner / "link.png").symlink_to(folder / "secret.png")
    library = name if keyword == "mtllib" else "face.mtl"
    (inner / "neutral.obj").write_text(NEUTRAL.replace("face.mtl", library))
    (inner / "face.mtl").write_text(f"newmtl skin\nmap_Kd {name}\n")
    with pytest.raises(InputError, match="outside the roots"):
        load("obj", inner)


def test_missing_libraries_and_textures_are_warnings(folder: Path) -> None:
    (folder / "maps" / "eye 1.png").unlink()
    assert "texture" in load("obj", folder).warnings[0]
    (folder / "face.mtl").unlink()
    assert "library not there" in load("obj", folder).warnings[0]


CUBE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "no points"),
        ("hello\n", "no points"),
        (CUBE, "no faces"),
        ("v 0 0\n" + CUBE, ":1: 2 numbers"),
        (CUBE + "v 1 x 0\n", ":4: 'x', expected a number"),
        (CUBE + "v 1 nan 0\n", ":4: NaN, infinity or over"),
        (CUBE + "v 1 1e999 0\n", ":4: NaN, infinity or over"),
        (CUBE + "f 1 2\n", ":4: 2 corners"),
        (CUBE + "f 1 2 3\nf 1 2 4\n", ":5: v index 4, expected 1..3"),
        (CUBE + "f 1 2 -4\n", ":4: v index -4"),
        (CUBE + "f 0 1 2\n", ":4: v index 0"),
        (CUBE + "f 1 2 99999999999999999999999\n", ":4: corner"),
        (CUBE + "f 1 2 999999999999\n", ":4: v index 999999999999"),
        (CUBE + "f 1/1 2/1 3/1\n", ":4: vt index 1"),
        (CUBE + "f 1 2 3/\\\n", ":4: "),
        (CUBE + "f 1 2 b\n", ":4: corner 'b'"),
        (CUBE.encode() + b"\xff\xfe\n", ":4: byte 0xff is not UTF-8"),
        (b"\0\1\2" * 40, "is binary"),
    ],
)
def test_bad_lines_are_named(tmp_path: Path, content: str | bytes, message: str) -> None:
    file = tmp_path / "neutral.obj"
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    if content == CUBE + "f 1 2 3/\\\n":  # a continued line that ends with the file
        assert read_obj(file).face_vertex_indices.tolist() == [0, 1, 2]
        return
    error = refused(lambda: load("obj", tmp_path), file)
    assert isinstance(error, InputError)
    assert message in str(error)


def test_forms_of_lines(tmp_path: Path) -> None:
    file = tmp_path / "face.obj"
    file.write_bytes(
        b"\xef\xbb\xbf# note\r\n  v\t0 0 0 1 0.5 0 # red\r\nv 1 0 \\\r\n0 0 1 0\r\nv 0 1 0 0 0 1\r\nv 1 1 0 1 1 1\r\n"
        b"vt 0.5\nvt 0.25 0.75 0\nvn 0 0 1\nf 1//1 2//1 3//1\nf 2/1 4/2/1 3/1/1\nl 1 2\nvp 1\n"
    )
    obj = read_obj(file)
    assert obj.points.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]
    assert obj.colors is not None
    half = ((0.5 + 0.055) / 1.055) ** 2.4  # in files colours are sRGB
    assert obj.colors.tolist() == [[1, pytest.approx(half), 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]]
    assert obj.uvs.tolist() == [[0.5, 0], [0.25, 0.75]]
    assert obj.uv_indices is None
    assert obj.face_vertex_indices.tolist() == [0, 1, 2, 1, 3, 2]
    file.write_text(file.read_text().replace("f 1//1 2//1 3//1\n", ""))
    uv_indices = read_obj(file).uv_indices
    assert uv_indices is not None
    assert uv_indices.tolist() == [0, 1, 0]


@pytest.mark.parametrize("white", [1, 255])
def test_colours_are_those_of_a_scan(tmp_path: Path, white: int) -> None:
    rows = [f"v {i} {i % 2} 0 {white * i / 4} {white * (1 - i / 4)} {white}" for i in range(5)]
    file = tmp_path / "face.obj"
    file.write_text("\n".join([*rows, "f 1 2 3", "f 3 4 5"]))
    (mesh,) = load("obj", file).parts.meshes
    levels = np.arange(5) / 4
    assert mesh.colors is not None
    np.testing.assert_allclose(to_srgb(mesh.colors), np.c_[levels, 1 - levels, np.ones(5)], atol=1e-9)
    np.testing.assert_array_equal(mesh.colors, read_scan(file).colors)


def test_groups_that_part_a_mesh_are_named(tmp_path: Path) -> None:
    rows = [f"v {i} {i % 2} {i // 3}" for i in range(6)]
    file, faces = tmp_path / "face.obj", ("f 1 2 3", "f 4 5 6")
    file.write_text("\n".join([*rows, "g lips", faces[0], "g chin", faces[1]]))
    assert load("obj", file).warnings == ("groups (g lines) of faces of one mesh, left out: lips, chin",)
    file.write_text("\n".join([*rows, "g default", *faces]))
    assert load("obj", file).warnings == ()
    file.write_text("\n".join([*rows, "o Lips", "g lips", faces[0], "o Chin", "g chin", faces[1]]))
    imported = load("obj", file)
    assert imported.warnings == ()
    assert [mesh.name for mesh in imported.parts.meshes] == ["Lips", "Chin"]


def test_line_numbers_stay_true_after_continued_lines(tmp_path: Path) -> None:
    file = tmp_path / "face.obj"
    file.write_text("v 0 \\\n0 \\\n0\nv 1 0 0\nv x 0 0\n")
    with pytest.raises(InputError, match=r"face\.obj:5: 'x'"):
        read_obj(file)


@settings(max_examples=40, deadline=None)
@given(
    points=st.lists(st.tuples(*[st.floats(-1e6, 1e6, width=32)] * 3), min_size=3, max_size=12),
    data=st.data(),
    style=st.sampled_from(["{0}", "{0}/{1}", "{0}/{1}/{0}", "{0}//{0}", "-{2}", "-{2}/{1}"]),
)
def test_what_is_written_is_read(
    tmp_path_factory: pytest.TempPathFactory, points: list[tuple[float, ...]], data: st.DataObject, style: str
) -> None:
    corner = st.integers(0, len(points) - 1)
    faces = data.draw(st.lists(st.lists(corner, min_size=3, max_size=6), min_size=1, max_size=6))
    rows = [f"v {x!r} {y!r} {z!r}" for x, y, z in points] + ["vt 0 0", "vt 1 1"]
    rows += ["f " + " ".join(style.format(i + 1, i % 2 + 1, len(points) - i) for i in face) for face in faces]
    file = tmp_path_factory.mktemp("obj") / "face.obj"
    file.write_text("\n".join(rows))
    obj = read_obj(file)
    assert obj.points.tolist() == [list(point) for point in points]
    assert obj.face_vertex_counts.tolist() == [len(face) for face in faces]
    assert obj.face_vertex_indices.tolist() == [i for face in faces for i in face]
    if "{1}" in style:
        assert obj.uv_indices is not None
        assert obj.uv_indices.tolist() == [i % 2 for face in faces for i in face]


FUZZ = settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))


@FUZZ
@given(data=st.data(), name=st.sampled_from(["Neutral.OBJ", "jawOpen.obj", "face.mtl", "landmarks.json"]))
def test_damaged_files_raise_our_errors_only(folder: Path, data: st.DataObject, name: str) -> None:
    content = (folder / name).read_bytes()
    (folder / name).write_bytes(data.draw(damaged(content)))
    refused(lambda: load("obj", folder), folder)
    (folder / name).write_bytes(content)


@pytest.mark.parametrize(
    "content", ["3", "[]", '{"multipie68": [8]}', '{"a b": [1]}', '{"indices": [1, 2], "names": ["x"]}', "[1.5]", "{"]
)
def test_bad_landmarks_are_refused(folder: Path, content: str) -> None:
    (folder / "landmarks.json").write_text(content)
    error = refused(lambda: load("obj", folder), folder / "landmarks.json")
    assert isinstance(error, InputError)


@pytest.mark.parametrize("content", [[2, 0], {"a": 2, "b": 0}, {"scheme": "multipie68", "indices": [2, 0]}])
def test_forms_of_landmarks(folder: Path, content: object) -> None:
    (folder / "landmarks.json").write_text(json.dumps(content))
    assert load("obj", folder).parts.meshes[0].landmarks["multipie68"].indices.tolist() == [2, 0]


def test_a_missing_or_ambiguous_neutral_is_refused(folder: Path) -> None:
    with pytest.raises(InputError, match=r"no rest\.obj there"):
        read(folder, Options(neutral="rest"))
    (folder / "neutral.obj").write_text(NEUTRAL)
    if len(list(folder.glob("*eutral*"))) == 2:
        with pytest.raises(InputError, match="2 files named"):
            load("obj", folder)
