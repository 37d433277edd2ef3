"""Faces through Blender: what comes back is what went in, with its edits; what is made there is whole."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from blender_python import PYTHON, blender, needs_blender, run_blender
from command_line import exit_code
from faces import replace_mesh, tiny_face
from import_data import shared
from node import validate as khronos
from small_head import make

import facepipe
from facepipe.checks import validate
from facepipe.importers import load
from facepipe.parts import FaceParts, Mesh, Skeleton
from facepipe.stage import save_parts
from facepipe.stage.values import same

pytestmark = [pytest.mark.gate, pytest.mark.slow, needs_blender]

NEAR = 1e-6  # of the head height; of weights 1e-6 itself


def check_same(before: FaceParts, after: FaceParts, height: float) -> None:
    """Points, shapes, inbetweens, weights, regions within 1e-6, and all else that a face holds but materials."""
    assert [mesh.name for mesh in before.meshes] == [mesh.name for mesh in after.meshes]
    for old, new in zip(before.meshes, after.meshes, strict=True):
        np.testing.assert_allclose(new.points, old.points, rtol=0, atol=NEAR * height)
        assert dense(old).keys() == dense(new).keys()
        for name, offsets in dense(old).items():
            np.testing.assert_allclose(dense(new)[name], offsets, rtol=0, atol=NEAR * height, err_msg=name)
        assert old.regions.keys() == new.regions.keys()
        for name, mask in old.regions.items():
            np.testing.assert_allclose(new.regions[name], mask, rtol=0, atol=NEAR)
        assert old.skin is not None
        assert new.skin is not None
        np.testing.assert_allclose(
            table(new, len(after.skeleton.joints)), table(old, len(before.skeleton.joints)), atol=NEAR
        )
    bare = [replace(parts, materials=(), recipe=None) for parts in (before, after)]
    assert same(*bare)
    assert {material.name for material in before.materials} == {material.name for material in after.materials}


def dense(mesh: Mesh) -> dict[str, np.ndarray]:
    """Offsets and normal offsets of every point, by shape and inbetween with its weight."""
    found = {}
    for shape in mesh.blendshapes:
        for key, one in (
            (shape.name, shape),
            *((f"{shape.name} {one.name} {one.weight:g}", one) for one in shape.inbetweens),
        ):
            for kind, values in (("offsets", one.offsets), ("normals", one.normal_offsets)):
                if values is not None:
                    found[f"{key} {kind}"] = np.zeros((len(mesh.points), 3))
                    found[f"{key} {kind}"][shape.point_indices] = values
    return found


def table(mesh: Mesh, joints: int) -> np.ndarray:
    """(n, joints) weights."""
    assert mesh.skin is not None
    result = np.zeros((len(mesh.points), joints))
    np.add.at(result, (np.arange(len(mesh.points))[:, None], mesh.skin.joint_indices), mesh.skin.joint_weights)
    return result


def in_blender(points: np.ndarray, parts: FaceParts) -> np.ndarray:
    """Points of a face as Blender shows them: metres, Z up."""
    turned = points if parts.up_axis == "Z" else points[:, [0, 2, 1]] * (1, -1, 1)
    return np.asarray(turned * parts.meters_per_unit)


def _in_one_material(mesh: Mesh) -> Mesh:
    """As Blender says of a mesh whose faces have one material."""
    return replace(mesh, material=mesh.material_faces[0].material, material_faces=())


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sample face."""
    path, parts = tmp_path_factory.mktemp("sample") / "face.usda", make()
    alone = [mesh if len(mesh.material_faces) != 1 else _in_one_material(mesh) for mesh in parts.meshes]
    save_parts(replace(parts, meshes=tuple(alone)), path)
    return path


def test_sample_comes_back(sample: Path, tmp_path: Path) -> None:
    weights = {"jawOpen": 0.6, "mouthSmileLeft": 0.3}
    found, said = blender("round_trip.py", sample, tmp_path / "out.usda", weights, False, answer=tmp_path / "a.npz")
    before, after = facepipe.open(sample), facepipe.open(tmp_path / "out.usda")
    check_same(before.parts(), after.parts(), before.head_height)
    assert "left out" not in said
    assert "were not imported" not in said
    assert same(before.parts().recipe, after.parts().recipe)
    assert validate(tmp_path / "out.usda") == ()
    # Blender itself shows shapes and inbetweens, whose drivers run there, as USD means them
    posed = before.split(before.evaluate(weights))
    for mesh in before.meshes:
        error = np.abs(found[f"shown {mesh.name}"] - in_blender(posed[mesh.name], before.parts())).max()
        assert error < 1e-5 * before.head_height * before.meters_per_unit


def test_edits_come_back_and_nothing_else(sample: Path, tmp_path: Path) -> None:
    found, said = blender("round_trip.py", sample, tmp_path / "out.usdc", {}, True, answer=tmp_path / "a.npz")
    check_played(sample, found)
    before, after = facepipe.open(sample).parts(), facepipe.open(tmp_path / "out.usdc").parts()
    assert validate(tmp_path / "out.usdc") == ()
    assert after.recipe is None
    assert "recipe of 'sample' left out" in said
    head, edited = before.meshes[0], after.meshes[0]
    moved = dense(edited)["jawOpen offsets"] - dense(head)["jawOpen offsets"]
    np.testing.assert_allclose(moved[7], (0, 0, 0.5), atol=1e-5)
    assert not np.delete(moved, 7, axis=0).any()
    assert all(
        same(*pair) for pair in zip(head.blendshapes, edited.blendshapes, strict=True) if pair[0].name != "jawOpen"
    )
    others = sum(float(mask[3]) for name, mask in head.regions.items() if name not in ("mouth", "neck"))
    set_there = [edited.regions[name][3] for name in ("mouth", "neck")]  # both 1 in Blender; in sum 1 on a stage
    np.testing.assert_allclose(set_there, 1 / (2 + others), atol=NEAR)
    rest = np.arange(len(head.points)) != 3
    for name, mask in head.regions.items():
        np.testing.assert_allclose(edited.regions[name][rest], mask[rest], atol=NEAR)
    teeth = [next(mesh for mesh in parts.meshes if mesh.name == "Teeth") for parts in (before, after)]
    np.testing.assert_allclose(
        teeth[1].points - teeth[0].points, np.tile((0, 0, 0.25), (len(teeth[0].points), 1)), atol=1e-5
    )
    assert same(before.sliders, after.sliders)
    assert same(head.landmarks, edited.landmarks)


def check_played(path: Path, found: Mapping[str, np.ndarray]) -> None:
    """Blender shows the clip that the face plays, as the face has it at that frame."""
    face = facepipe.open(path)
    assert face.played is not None
    assert found["rate"] == face.frames_per_second
    local, weights = face.sample(face.played, int(found["frame"]))
    assert max(weights.values()) > 0.05
    points = face.split(face.evaluate(weights, joint_transforms=local))
    for name, one in points.items():
        off = np.abs(found[f"played {name}"] - in_blender(one, face.parts())).max()
        assert off < 1e-5 * face.head_height * face.meters_per_unit


def test_objects_are_found_by_their_names_too(sample: Path, tmp_path: Path) -> None:
    """Blender before 4.4 doesn't say what it made of a prim."""
    found, said = blender("old_import.py", sample, answer=tmp_path / "a.npz")
    assert found["same"].tolist() == [True] * 3, said


def test_makehuman_comes_back(tmp_path: Path) -> None:
    source = shared("makehuman/makehuman_head.npz")
    save_parts(load("makehuman", source).parts, tmp_path / "face.usdc")
    blender("round_trip.py", tmp_path / "face.usdc", tmp_path / "out.usdc", {}, False, answer=tmp_path / "a.npz")
    before, after = facepipe.open(tmp_path / "face.usdc"), facepipe.open(tmp_path / "out.usdc")
    check_same(before.parts(), after.parts(), before.head_height)
    assert validate(tmp_path / "out.usdc") == ()


@pytest.mark.parametrize("joints", [True, False])
def test_loose_meshes_and_faces_without_joints_come_back(tmp_path: Path, joints: bool) -> None:
    parts = tiny_face()
    colors = np.random.default_rng(3).random((len(parts.meshes[0].points), 3)).astype(np.float32)
    parts = replace(parts, meshes=(replace_mesh(parts.meshes[0], colors=colors), *parts.meshes[1:]))
    if not joints:
        bare = tuple(replace(mesh, skin=None) for mesh in parts.meshes)
        parts = replace(parts, skeleton=Skeleton(), meshes=bare)
    save_parts(parts, tmp_path / "face.usda")
    _, said = blender(
        "round_trip.py", tmp_path / "face.usda", tmp_path / "out.usda", {}, False, answer=tmp_path / "a.npz"
    )
    before, after = facepipe.open(tmp_path / "face.usda").parts(), facepipe.open(tmp_path / "out.usda").parts()
    assert same(before, after), said


UNITS: Sequence[tuple[dict[str, object], str, float]] = (
    ({}, "Z", 1.0),
    ({"convert_orientation": True, "convert_scene_units": "CENTIMETERS"}, "Y", 0.01),
    ({"merge_parent_xform": True, "author_blender_name": False}, "Z", 1.0),
)


@pytest.mark.parametrize(("options", "up", "unit"), UNITS)
def test_a_face_made_in_blender(tmp_path: Path, options: dict[str, object], up: str, unit: float) -> None:
    found, said = blender("made_face.py", tmp_path / "out.usda", options, answer=tmp_path / "a.npz")
    assert not [one for one in validate(tmp_path / "out.usda") if one.check != "facepipe:Plausible"], said
    face = facepipe.open(tmp_path / "out.usda")
    assert (face.up_axis, face.meters_per_unit) == (up, pytest.approx(unit))
    assert face.skeleton.joints == ("root", "root/jaw_L")
    assert face.skeleton.names == ("root", "jaw.L")
    (mesh,) = face.meshes
    assert {*mesh.regions} == {"mouth", "chin"}
    np.testing.assert_allclose(sum(mesh.regions.values()), 1.0, atol=1e-6)
    assert "unused" in said
    smile, wide = mesh.blendshapes
    assert [(inbetween.name, inbetween.weight) for inbetween in smile.inbetweens] == [("half", 0.5)]
    assert smile.normal_offsets is not None
    assert wide.normal_offsets is not None
    # Blender's own deformation is the oracle: shapes, pose, and the places of its objects
    to_stage = np.diag([1 / unit] * 3) @ (np.eye(3) if up == "Z" else np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]))
    move = np.eye(4)
    move[:3, :3] = to_stage
    worlds = move @ found["pose"] @ np.linalg.inv(move @ found["rest"]) @ face.skeleton.bind_transforms
    local = np.array([np.linalg.inv(face.skeleton.transform) @ worlds[0], np.linalg.inv(worlds[0]) @ worlds[1]])
    posed = face.evaluate({"smile": 1.0, "wide": 0.25}, joint_transforms=local)
    assert np.abs(posed - found["shown"] @ to_stage.T).max() < 1e-5 * face.head_height


def test_blender_alone_where_a_face_can_not_be_written(tmp_path: Path) -> None:
    done = run_blender("bad_faces.py", tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    lines = [line for line in done.stderr.splitlines() if line.startswith("facepipe: ")]
    assert any("Head: its object mirrors or flattens it" in line for line in lines)
    assert any("expected one scale" in line for line in lines)


def test_one_click_export_validates(sample: Path, tmp_path: Path) -> None:
    settings = {"directory": str(tmp_path), "file_name": "hero"}
    steps = [["mode_set", {"mode": "EDIT"}], ["export", settings]]
    found, said = blender("operators.py", sample, steps, answer=tmp_path.parent / "a.npz")
    assert found["said"].tolist() == ["", ""], said
    assert found["mode"] == "OBJECT"  # so that what was being edited is in the files
    names = {one.name for one in tmp_path.iterdir()}
    assert names == {"hero.glb", "hero.onnx", "hero.onnx.json", "hero.report.json"}
    for suffix in ("glb", "onnx"):
        assert not [one for one in validate(tmp_path / f"hero.{suffix}") if one.severity != "info"]
    issues = khronos([tmp_path / "hero.glb"])[tmp_path / "hero.glb"]["issues"]
    assert (issues["numErrors"], issues["numWarnings"]) == (0, 0)
    report = json.loads((tmp_path / "hero.report.json").read_text())
    assert {*report["files"]} == names
    assert not [one for one in report["findings"] if one["severity"] != "info"]


def test_the_files_are_named_after_the_face_and_overwritten_on_demand(sample: Path, tmp_path: Path) -> None:
    step = {"directory": str(tmp_path)}
    steps = [["export", step], ["export", step], ["export", {**step, "overwrite": True}], ["export", step]]
    found, said = blender("operators.py", sample, steps, answer=tmp_path.parent / "a.npz")
    names = {one.name for one in tmp_path.iterdir()}
    assert names == {"Face.glb", "Face.onnx", "Face.onnx.json", "Face.report.json"}  # no object is called so
    assert [bool(one) for one in found["said"].tolist()] == [False, True, False, True]
    assert "Face.glb: exists" in found["said"][1]
    assert "Warning:" not in said  # what formats don't hold of the sample is no fault
    assert "Info: not in the files: " in said
    report = json.loads((tmp_path / "Face.report.json").read_text())
    assert report["warnings"] == []
    assert report["facts"]


def test_the_panel_asks_for_a_folder_and_before_it_overwrites(sample: Path, tmp_path: Path) -> None:
    (tmp_path / "hero.glb").write_bytes(b"")
    found, _ = blender("asking.py", sample, tmp_path, answer=tmp_path.parent / "a.npz")
    assert found["asked"].tolist() == ["folder?", "INVOKE_DEFAULT hero ask=True", "Overwrite? hero.glb"]
    assert (tmp_path / "hero.glb").read_bytes() == b""


def test_blend_recipe_applied_in_blender(tmp_path: Path) -> None:
    for seed, name in enumerate("abc"):
        save_parts(replace(make(seed), played=None), tmp_path / f"{name}.usda")
    paths = [str(tmp_path / f"{name}.usda") for name in ("a", "b", "blended")]
    assert exit_code("blend", *paths[:2], "-o", paths[2], "--set", "nose=0.2,0.8") == 0
    shutil.copy(paths[2], tmp_path / "imported.usda")
    shutil.copy(tmp_path / "c.usda", paths[1])  # a source changes
    steps = [["blend", {}], ["export", {"directory": str(tmp_path), "file_name": "out"}]]
    found, said = blender("operators.py", tmp_path / "imported.usda", steps, answer=tmp_path / "a.npz")
    assert found["said"].tolist() == ["", ""], said
    assert "b.usda changed" in said
    assert "recipe of 'blend' left out" not in said
    assert exit_code("blend", "--edit", paths[2], "--force") == 0
    wanted = facepipe.open(paths[2])
    points = wanted.split(wanted.evaluate())
    for mesh in wanted.meshes:
        off = np.abs(found[f"points {mesh.name}"] - in_blender(points[mesh.name], wanted.parts())).max()
        assert off < 2 * NEAR * wanted.head_height * wanted.meters_per_unit


def test_operators_say_in_one_line_what_is_wrong(sample: Path, tmp_path: Path) -> None:
    out = ["export", {"directory": str(tmp_path)}]
    found, _ = blender("operators.py", "", [out, ["blend", {}]], answer=tmp_path.parent / "a.npz")
    assert all("Cube: a mesh without armature and shape keys" in line for line in found["said"].tolist())
    lost = ["blend", {"filepath": str(tmp_path / "lost.usda")}]
    steps = [["blend", {}], lost, ["export", {"directory": str(tmp_path / "none")}]]
    found, _ = blender("operators.py", sample, steps, answer=tmp_path.parent / "a.npz")
    said = found["said"].tolist()
    assert "recipe of 'sample', expected a face made by `facepipe blend`" in said[0]
    assert "lost.usda: no such file" in said[1]
    assert "the folder does not exist" in said[2]
    assert all(len(line.splitlines()) == 1 for line in said)
    assert not list(tmp_path.iterdir())


def test_lost_source_of_a_recipe(tmp_path: Path) -> None:
    for seed, name in enumerate("ab"):
        save_parts(replace(make(seed), played=None), tmp_path / f"{name}.usda")
    paths = [str(tmp_path / f"{name}.usda") for name in ("a", "b", "c")]
    assert exit_code("blend", *paths[:2], "-o", paths[2]) == 0
    Path(paths[1]).unlink()
    before = facepipe.open(paths[2])
    found, _ = blender("operators.py", paths[2], [["blend", {}]], answer=tmp_path / "a.npz")
    assert "b.usda: no such file" in found["said"][0]
    points = before.split(before.evaluate())
    off = found["points Head"] - in_blender(points["Head"], before.parts())
    assert np.abs(off).max() < 2 * NEAR * before.head_height * before.meters_per_unit


def test_the_extension_installs_in_blender(sample: Path, tmp_path: Path) -> None:
    addon = tmp_path / "facepipe.zip"
    asked = [os.environ[PYTHON], "-c", "import sys; print(*sys.version_info[:2])"]
    version = subprocess.run(asked, capture_output=True, text=True, check=True).stdout.split()
    words = ["blender-addon", "-o", str(addon), "--blender", "5.0" if version == ["3", "11"] else "5.2"]
    done = subprocess.run([sys.executable, "-m", "facepipe", *words], capture_output=True)
    assert done.returncode == 0, done.stderr
    os.environ["BLENDER_USER_RESOURCES"] = str(tmp_path / "user")
    try:
        done = run_blender("install.py", addon, sample, tmp_path / "out.usda")
    finally:
        del os.environ["BLENDER_USER_RESOURCES"]
    assert done.returncode == 0, done.stdout + done.stderr
    before, after = facepipe.open(sample), facepipe.open(tmp_path / "out.usda")
    check_same(before.parts(), after.parts(), before.head_height)
