"""Levels of detail in one GLB: each is the face at that level, engines show the finest."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from engines import RUNNERS, File, Pose
from facepipe_gltf.options import ENGINES
from gltf_reader import Gltf, read
from level_faces import MILLIMETRES, face_with_lips
from node import three_load, validate

import facepipe
from facepipe.core.errors import InputError
from facepipe.parts import Animation
from facepipe.stage import Face, save_parts

METRES = MILLIMETRES / 1000
NAMES = ("Face", "Eye")


@pytest.fixture(scope="module")
def levels(tmp_path_factory: pytest.TempPathFactory) -> Face:
    folder = tmp_path_factory.mktemp("levels")
    weights = np.array([[0.0], [0.8]])
    clip = Animation(name="talk", times=np.arange(2.0), shapes=("open",), shape_weights=weights)
    save_parts(replace(face_with_lips(), animations=(clip,)), folder / "face.usda")
    facepipe.lod(folder / "face.usda", out=folder / "lods.usda", triangles=(1000, 300))
    return facepipe.open(folder / "lods.usda")


@pytest.fixture(scope="module")
def glb(levels: Face, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("glb") / "lods.glb"
    report = facepipe.export(levels, path, lods=True, animations=True)
    assert report.counts["levels"] == 3
    return path


def shown(file: Gltf) -> list[str]:
    return [file.list("nodes")[node]["name"] for node in file.json["scenes"][0]["nodes"]]


def test_nodes_name_those_that_may_take_their_place(glb: Path) -> None:
    file = read(glb)
    nodes = file.list("nodes")
    assert shown(file)[:2] == [*NAMES]
    assert not any("lod" in name for name in shown(file))
    assert file.json["extensionsUsed"] == ["MSFT_lod"]
    for node, name in zip(nodes, NAMES, strict=False):
        ids = node["extensions"]["MSFT_lod"]["ids"]
        assert [nodes[one]["name"] for one in ids] == [f"{name}_lod1", f"{name}_lod2"]
        assert all(nodes[one]["skin"] == node["skin"] for one in ids)


@pytest.mark.parametrize("number", [0, 1, 2])
def test_each_level_moves_as_the_face_at_that_level(levels: Face, glb: Path, number: int) -> None:
    file, level = read(glb), levels.at_level(number)
    suffix = f"_lod{number}" if number else ""
    for name in NAMES:
        expected = level.split(level.evaluate({"open": 0.7}) * METRES)[name]
        np.testing.assert_allclose(file.evaluate({"open": 0.7})[name + suffix], expected, atol=1e-6)
        expected = level.split(level.evaluate({"open": 0.4}) * METRES)[name]
        np.testing.assert_allclose(file.pose("talk", 0.5)[name + suffix], expected, atol=1e-6)


def test_a_level_alone_is_what_all_hold_of_it(levels: Face, glb: Path, tmp_path: Path) -> None:
    facepipe.export(levels, tmp_path / "one.glb", lod=2)
    file, alone = read(glb), read(tmp_path / "one.glb")
    for name in NAMES:
        one, other = alone.mesh(name)["primitives"], file.mesh(f"{name}_lod2")["primitives"]
        for mine, theirs in zip(one, other, strict=True):
            for key in mine["attributes"]:
                values = (of.decoded(each["attributes"][key]) for of, each in ((alone, mine), (file, theirs)))
                np.testing.assert_array_equal(*values)


def test_the_khronos_validator_finds_nothing(glb: Path) -> None:
    issues = validate([glb])[glb]["issues"]
    assert issues["numErrors"] == issues["numWarnings"] == 0
    assert {one["code"] for one in issues["messages"]} <= {"UNSUPPORTED_EXTENSION", "UNUSED_OBJECT"}
    assert [one for one in facepipe.validate(glb) if one.severity != "info"] == []


def test_three_shows_the_finest(levels: Face, glb: Path) -> None:
    loaded = three_load(glb, {}, {})
    points = {point for mesh in loaded["meshes"] if mesh["name"].startswith("Face") for point in mesh["points"]}
    assert len(points) == len(levels.meshes[0].points)
    assert all("lod" not in mesh["name"] for mesh in loaded["meshes"])


class Finest(File):
    """The file with what is in its scene alone."""

    def primitives(self) -> list[tuple[str, np.ndarray]]:
        return [primitive for primitive in super().primitives() if "_lod" not in primitive[0]]


@pytest.mark.slow
@pytest.mark.parametrize("engine", RUNNERS)
def test_engines_show_what_the_presets_say(engine: str, levels: Face, tmp_path: Path) -> None:
    """The finest, and posed right; or all at once, and then `--engine` refuses them."""
    joints = {name: [0.0] * 6 + [1.0] * 4 for name in ("head", "jaw")}
    weights = {name: {"open": 0.0, "open_half": 1.0} for name in ("Face", "Face_lod1", "Face_lod2")}
    pose = Pose({**weights, **{name: {} for name in ("Eye", "Eye_lod1", "Eye_lod2")}}, joints)
    one_level = engine == "assimp" or ENGINES[engine].lods
    facepipe.export(levels, tmp_path / "lods.glb", lods=True)  # Blender calls meshes of files with clips otherwise
    (pieces,) = RUNNERS[engine]([(Finest if one_level else File)(tmp_path / "lods.glb", [pose])], tmp_path)
    assert any("_lod" in piece.mesh for piece in pieces) == (not one_level)
    if one_level:
        expected = levels.split(levels.evaluate({"open": 0.5}) * METRES)
        for piece in pieces:
            np.testing.assert_allclose(piece.positions[0], expected[piece.mesh][piece.points], atol=1e-5)


def test_it_comes_back_as_the_finest(levels: Face, glb: Path) -> None:
    back = facepipe.read(glb)
    assert any("4 nodes with a mesh are not in the scene" in line for line in back.warnings)
    assert [mesh.name for mesh in back.meshes] == [*NAMES]
    np.testing.assert_allclose(back.evaluate({"open": 1.0}), levels.evaluate({"open": 1.0}), atol=1e-4)


def test_levels_go_into_a_glb_at_once(levels: Face, glb: Path, tmp_path: Path) -> None:
    base = Path(levels.stage.GetRootLayer().realPath).with_name("face.usda")
    facepipe.lod(base, out=tmp_path / "o.glb", triangles=(1000, 300))
    assert [mesh["name"] for mesh in read(tmp_path / "o.glb").list("meshes")] == [
        mesh["name"] for mesh in read(glb).list("meshes")
    ]


def test_names_change_on_all_levels(levels: Face, tmp_path: Path) -> None:
    (tmp_path / "names.json").write_text(json.dumps({"open": "jawOpen"}))
    facepipe.export(levels, tmp_path / "o.glb", lods=True, rename=str(tmp_path / "names.json"))
    file = read(tmp_path / "o.glb")
    for name in ("Face", "Face_lod1", "Face_lod2"):
        assert "jawOpen" in file.targets(name)
        assert "open" not in file.targets(name)


def test_what_can_not_be_written_is_refused(levels: Face, tmp_path: Path) -> None:
    out, plain = tmp_path / "o.glb", Face.from_parts(face_with_lips())
    with pytest.raises(InputError, match="--lods: the face has no levels of detail"):
        facepipe.export(plain, out, lods=True)
    with pytest.raises(InputError, match="no level of detail 1, the face has none"):
        facepipe.export(plain, out, lod=1)
    with pytest.raises(InputError, match="--lods: given with --lod, expected one of them"):
        facepipe.export(levels, out, lods=True, lod=1)
    with pytest.raises(InputError, match="Godot 3 shows all levels at once"):
        facepipe.export(levels, out, lods=True, engine="godot")
    assert list(tmp_path.iterdir()) == []
