"""Skin from joint positions: properties of weights on the sample and on real heads, and bad input."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import done, failed, run
from faces import grid_mesh, tiny_face
from node import validate as khronos
from oracle import bake, difference, random_coefficients
from skin_joints import HELD, ICT_KIND, KINDS, head, landmark_joints, weights_of, without_joints

import facepipe
from facepipe.checks import validate_stage
from facepipe.core.errors import InputError, TopologyError
from facepipe.parts import FaceParts, Skeleton
from facepipe.registry import exporter
from facepipe.rig import rest_coefficients
from facepipe.stage import Face, save_parts
from facepipe.stage.author_changes import author_changes
from facepipe.verbs.skin import JointSet, JointSpec, SkinFace, SkinOptions, SkinReport, read_joints
from facepipe.verbs.skin.surface import Surface, surface_of

STEEPEST = 0.35  # of a weight, per mm
Array = np.ndarray[Any, Any]


@cache
def skinned(kind: str, influences: int = 4) -> tuple[Face, SkinReport]:
    face = Face.from_parts(without_joints(head(kind)))
    joints = landmark_joints(face, HELD[kind])
    report = SkinFace(joints=joints, options=SkinOptions(influences=influences))(face)
    return Face(face.stage), report


@cache
def surface(kind: str) -> Surface:
    return surface_of(skinned(kind)[0].parts(), kind)


def column(kind: str, joint: str) -> Array:
    """(m,) its weights at the sewn points."""
    face = skinned(kind)[0]
    place = np.unique(surface(kind).group, return_index=True)[1]
    return weights_of(face)[place, face.skeleton.joints.index(joint)]


@pytest.mark.parametrize(
    ("kind", "count"),
    [
        pytest.param("sample", 2, marks=pytest.mark.slow),
        ("sample", 4),
        pytest.param("ict", 4, marks=pytest.mark.slow),
        ("makehuman", 4),
    ],
)
def test_weights_are_shares_of_few_joints(kind: str, count: int) -> None:
    face, report = skinned(kind, count)
    weights = weights_of(face)
    assert weights.min() >= 0
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-6)
    assert (weights > 0).sum(axis=1).max() == report.influences == count
    assert not report.weightless
    assert report.joints == 19


@pytest.mark.parametrize("kind", KINDS)
def test_weights_are_smooth(kind: str) -> None:
    report = skinned(kind)[1]
    assert report.largest_step_per_mm <= STEEPEST
    place = np.unique(surface(kind).group, return_index=True)[1]
    a, b = surface(kind).edges.T
    weights = weights_of(skinned(kind)[0])[place]
    assert np.abs(weights[a] - weights[b]).max() == pytest.approx(report.largest_step, abs=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_a_lip_is_not_moved_by_the_other_nor_a_lid(kind: str) -> None:
    marks = surface(kind).landmarks
    assert marks is not None
    upper, lower = [50, 51, 52, 61, 62, 63], [56, 57, 58, 65, 66, 67]
    for name in ("", "Left", "Right"):
        assert not column(kind, f"head/jaw/lipLower{name}")[marks[upper]].any()
        assert not column(kind, f"head/lipUpper{name}")[marks[lower]].any()
    assert column(kind, "head/jaw")[marks[upper]].max() == 0
    for side, above, below in (("Right", [37, 38], [40, 41]), ("Left", [43, 44], [46, 47])):
        assert not column(kind, f"head/lidLower{side}")[marks[above]].any()
        assert not column(kind, f"head/lidUpper{side}")[marks[below]].any()
        assert column(kind, f"head/lidUpper{side}")[marks[above]].min() > 0.5
        assert column(kind, f"head/lidLower{side}")[marks[below]].min() > 0.5


@pytest.mark.parametrize("kind", KINDS)
def test_joints_move_what_they_stand_at(kind: str) -> None:
    marks = surface(kind).landmarks
    assert marks is not None
    for joint, mark in (("head/noseTip", 30), ("head/browLeft", 24), ("head/lipUpper", 51), ("head/lipCornerLeft", 54)):
        assert column(kind, joint)[marks[mark]] > 0.5
        assert column(kind, joint)[marks[[0, 16, 27]]].max() < 0.05


@pytest.mark.parametrize("kind", KINDS)
def test_eyeballs_and_teeth_are_rigid(kind: str) -> None:
    report = skinned(kind)[1]
    names = ("EyeLeft", "EyeRight") if kind == "makehuman" else ("EyeballLeft", "EyeballRight")
    assert [report.rigid[name] for name in names] == ["head/eyeLeft", "head/eyeRight"]
    if kind == "makehuman":
        assert (report.rigid["TeethUpper"], report.rigid["TeethLower"]) == ("head", "head/jaw")
        return
    whole = surface(kind)
    teeth = whole.mesh == whole.mesh_names.index("Teeth")
    jaw = column(kind, "head/jaw")
    middle = whole.points[teeth, 1].mean()
    for number in np.unique(whole.component[teeth]):
        own = whole.component == number
        assert set(jaw[own]) == {float(whole.points[own, 1].mean() < middle)}


@pytest.mark.parametrize("kind", ["whole sample", ICT_KIND, "makehuman"])
def test_a_symmetric_face_has_symmetric_weights(kind: str) -> None:
    from scipy.spatial import cKDTree

    whole = surface(kind)
    away, mirror = cKDTree(whole.points).query(whole.points * [-1, 1, 1])
    paired = (away < 1e-3) & (whole.component == whole.main)
    assert paired.sum() > 0.9 * len(whole.inside)
    for left in ("head/browLeft", "head/lipCornerLeft", "head/lidUpperLeft", "head/jaw", "head"):
        found = column(kind, left.replace("Left", "Right"))[mirror]
        apart = np.abs(column(kind, left) - found)[paired]
        assert np.percentile(apart, 99) < 0.02
        assert apart.max() < 0.12  # ICT's triangles at the lids have no mirror image


@pytest.mark.parametrize("kind", KINDS)
def test_the_result_is_a_valid_face_that_deforms_as_usd_says(kind: str, tmp_path: Path) -> None:
    face = skinned(kind)[0]
    assert face.rig().evaluate() == pytest.approx(Face.from_parts(without_joints(head(kind))).evaluate(), abs=1e-5)
    pose = face.rig().local_transforms(random_coefficients(np.random.default_rng(1), 19, 0.5))
    shapes = {face.shapes[0]: 0.7} if face.shapes else {}
    found = face.evaluate(shapes, joint_transforms=pose)
    assert difference(face, found, bake(face, shapes, pose)) < 1e-5
    face.save(tmp_path / "skinned.usdc")
    assert not validate_stage(tmp_path / "skinned.usdc")


@pytest.mark.parametrize("kind", ["sample", ICT_KIND])
def test_the_skinned_head_exports(kind: str, tmp_path: Path) -> None:
    face = skinned(kind)[0]
    glb = exporter("head.glb")
    report = glb.export(face, tmp_path / "head.glb", glb.Options(shapes="jawOpen"))
    assert report.counts["joints"] == 19
    issues = khronos([tmp_path / "head.glb"])[tmp_path / "head.glb"]["issues"]
    assert issues["numErrors"] == issues["numWarnings"] == 0


@pytest.mark.parametrize("kind", ["sample", ICT_KIND])
def test_the_jaw_opens_the_chin_and_lower_teeth_alone(kind: str) -> None:
    face = skinned(kind)[0]
    marks = surface(kind).landmarks
    assert marks is not None
    coefficients = rest_coefficients(19)
    coefficients[face.skeleton.joints.index("head/jaw"), 3] = 0.3
    moved = np.linalg.norm(face.evaluate(coefficients=coefficients) - face.evaluate(), axis=1) * face.mm_per_unit
    first = np.unique(surface(kind).group, return_index=True)[1]
    at = moved[first[marks]]
    assert at[8] > 15
    assert at[[27, 30, 33, 51, 62, 19, 24]].max() == 0


def test_triangles_of_a_part_are_all_those_between_its_points() -> None:
    whole = surface_of(head("sample"), "sample")
    corners = np.unique(whole.triangles[7])
    found = whole.part_triangles(corners)
    assert sorted(map(sorted, found.tolist())) == [[0, 1, 2]]
    assert len(whole.part_triangles(np.arange(len(whole.points)))) == len(whole.triangles)


def test_no_weight_lies_beyond_a_radius() -> None:
    face = Face.from_parts(without_joints(head("sample")))
    whole = surface_of(face.parts(), "sample")
    nose = whole.points[whole.landmarks][30]
    joints = (
        JointSpec(path="head", position=(0, 60, 0)),
        JointSpec(path="head/nose", position=tuple(nose), radius=25.0),
    )
    SkinFace(joints=JointSet(joints=joints, unit="mm"))(face)
    weights = weights_of(Face(face.stage))[np.unique(whole.group, return_index=True)[1], 1]
    away = np.linalg.norm(whole.points - nose, axis=1)
    assert weights[away > 25].max() == 0
    assert weights[away < 3].min() > 0.9


def test_regions_bound_a_joint() -> None:
    face = Face.from_parts(without_joints(head("sample")))
    whole = surface_of(face.parts(), "sample")
    joints = (
        JointSpec(path="head", position=(0, 60, 0)),
        JointSpec(path="head/nose", position=tuple(whole.points[whole.landmarks][30]), regions=("nose",)),
    )
    SkinFace(joints=JointSet(joints=joints, unit="mm"))(face)
    again = Face(face.stage)
    weights = weights_of(again)[:, 1]
    mask = np.asarray(again.meshes[0].regions["nose"])
    own = weights[: len(mask)]
    assert own[mask == 0].max() == 0
    assert own[mask == 1].mean() > 0.5


def test_points_on_both_sides_of_a_cut_move_together() -> None:
    left = grid_mesh("Left", 8)
    right = replace(grid_mesh("Right", 8), points=left.points + np.array([7.0, 0, 0]))
    parts = FaceParts(name="Two", meshes=(left, right), skeleton=Skeleton())
    face = Face.from_parts(parts)
    joints = (JointSpec(path="a", position=(-2.0, 2.0, 0)), JointSpec(path="b", position=(9.0, 5.0, 0)))
    SkinFace(joints=JointSet(joints=joints))(face)
    weights = weights_of(Face(face.stage))
    for row in range(8):
        np.testing.assert_array_equal(weights[row * 8 + 7], weights[64 + row * 8])
    assert 0.02 < weights[7, 0] < 0.98


def test_axes_are_the_parents_unless_given() -> None:
    half = np.sqrt(0.5)
    joints = (
        JointSpec(path="a", position=(0, 0, 0), rotation=(0, 0, half, half)),
        JointSpec(path="a/b", position=(1.0, 2.0, 0)),
        JointSpec(path="a/b/c", position=(1.0, 3.0, 0), rotation=(0, 0, 2.0, 2.0)),
    )
    face = Face.from_parts(replace(tiny_face(), meshes=(grid_mesh(),), skeleton=Skeleton()))
    SkinFace(joints=JointSet(joints=joints))(face)
    bind = Face(face.stage).skeleton.bind_transforms
    np.testing.assert_allclose(bind[:, :3, 3], [joint.position for joint in joints], atol=1e-6)
    quarter = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    np.testing.assert_allclose(bind[:, :3, :3], [quarter, quarter, quarter @ quarter], atol=1e-6)


def test_skinning_again_with_the_same_joints_is_the_same() -> None:
    face = Face.from_parts(without_joints(head("sample")))
    joints = landmark_joints(face, HELD["sample"])
    SkinFace(joints=joints)(face)
    again = Face(face.stage)
    before = weights_of(again)
    SkinFace(joints=joints)(again)
    np.testing.assert_allclose(weights_of(Face(face.stage)), before, atol=1e-6)


def test_joints_are_added_to_a_face_that_has_none_and_to_no_other() -> None:
    bare = Face.from_parts(without_joints(tiny_face()))
    skeleton = tiny_face().skeleton
    lines = author_changes(bare, replace(bare.parts(), skeleton=skeleton))
    assert lines[0] == "Skeleton: 3 joints"
    assert Face(bare.stage).skeleton.joints == skeleton.joints
    with pytest.raises(TopologyError, match="other joints"):
        author_changes(Face(bare.stage), replace(Face(bare.stage).parts(), skeleton=Skeleton()))
    for joints in (("b/c", "b"), ("a", "a"), ("a", "", "b")):
        other = replace(
            skeleton,
            joints=joints,
            **{name: getattr(skeleton, name)[: len(joints)] for name in ("bind_transforms", "rest_transforms")},
        )
        fresh = Face.from_parts(without_joints(tiny_face()))
        with pytest.raises(InputError, match="joints that no skeleton can have"):
            author_changes(fresh, replace(fresh.parts(), skeleton=other))
    with pytest.raises(TopologyError, match="bind transforms"):
        author_changes(fresh, replace(fresh.parts(), skeleton=replace(skeleton, joints=("a",))))


GOOD: dict[str, Any] = {
    "unit": "mm",
    "joints": {"head": {"position": [0, 60, 20]}, "head/jaw": {"position": [0, 0, 15]}},
}


def test_a_joint_without_rotation_has_none(tmp_path: Path) -> None:
    (tmp_path / "joints.json").write_text(json.dumps(GOOD))
    assert {joint.rotation for joint in read_joints(tmp_path / "joints.json").joints} == {(0.0, 0.0, 0.0, 1.0)}


def with_joint(**fields: object) -> dict[str, Any]:
    return {**GOOD, "joints": {**GOOD["joints"], "head/x": {"position": [0, 0, 0], **fields}}}


BAD_FILES = {
    "[]": "expected a JSON object",
    "{": "is not JSON",
    '{"joints": {"a": {"position": [0,0,0]}, "a": {"position": [0,0,0]}}}': "'a' twice",
    '{"joints": {"a": {"position": [0, 0, NaN]}}}': "position -> 2: nan, expected a finite number",
    json.dumps({"joints": {}}): "0 joints, expected 1",
    json.dumps({"joints": {"root/jaw": {"position": [0, 0, 0]}}}): "no parent 'root'",
    json.dumps({"joints": {"a b": {"position": [0, 0, 0]}}}): "expected names of ASCII letters",
    json.dumps({"joints": {"a/": {"position": [0, 0, 0]}}}): "expected names of ASCII letters",
    json.dumps({"joints": {"a": {}}}): "no 'position', expected one",
    json.dumps({"joints": {"a": {"position": [1, 2]}}}): "expected a list of 3 of which each is a finite number",
    json.dumps({"joints": {"a": {"position": [1, 2, 1e300]}}}): "expected a number from -1e+09 to 1e+09",
    json.dumps({"joints": {"a": {"position": [1, 2, True]}}}): "position -> 2: True, expected a finite number",
    json.dumps({**GOOD, "unit": "inch"}): "unit: 'inch', expected stage, mm, cm, m",
    json.dumps({**GOOD, "bones": 1}): "'bones' is unknown",
    json.dumps({**GOOD, "parts": {"Teeth*": "tail"}}): "no joint 'tail', expected one of the file",
    json.dumps({**GOOD, "parts": {"Teeth*": {"upper": "head"}}}): "Teeth*: no 'lower', expected one",
    json.dumps(with_joint(radius=-1)): "expected a length above 0",
    json.dumps(with_joint(rotation=[0, 0, 0, 0])): "expected a unit quaternion",
    json.dumps(with_joint(regions="nose")): "regions: 'nose', expected a list of which each is a text",
    json.dumps(with_joint(surface=1)): "expected true or false",
    json.dumps(with_joint(weight=1)): "'weight' is unknown",
}


@pytest.mark.parametrize(("text", "message"), BAD_FILES.items())
def test_bad_files_are_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "joints.json").write_text(text)
    with pytest.raises(InputError) as caught:
        read_joints(tmp_path / "joints.json")
    assert message in str(caught.value)
    assert str(tmp_path) in str(caught.value)
    assert "\n" not in str(caught.value)


BAD_REQUESTS = {
    "joints outside": (with_joint(position=[0, 0, 1e6]), "mm from the face"),
    "unknown region": (with_joint(regions=["moustache"]), "no 'moustache', did you mean 'mouth'?"),
    "unknown mesh": ({**GOOD, "parts": {"Horn*": "head"}}, "'Horn*' matches no mesh"),
    "nowhere allowed": (
        {"unit": "mm", "joints": {"a": {"position": [0, 0, 100], "radius": 20}}},
        "that no joint may move",
    ),
    "only an eye": ({"unit": "mm", "joints": {"a": {"position": [31, 33, 76]}}}, "no joint moves the face itself"),
}


@pytest.mark.parametrize("name", BAD_REQUESTS)
def test_bad_requests_say_so_in_one_line_and_write_nothing(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content, message = BAD_REQUESTS[name]
    face, joints, out = tmp_path / "face.usdc", tmp_path / "joints.json", tmp_path / "out.usdc"
    save_parts(without_joints(head("sample")), face)
    joints.write_text(json.dumps(content))
    line = failed(capsys, "skin", face, "--joints", joints, "-o", out, folder=tmp_path)
    assert message in line
    assert str(tmp_path) in line or "face.usdc" in line


def test_the_command_authors_a_layer_with_recipe_and_picture(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    face, joints, out = tmp_path / "face.usdc", tmp_path / "joints.json", tmp_path / "out.usda"
    save_parts(without_joints(head("sample")), face)
    joints.write_text(json.dumps({**GOOD, "parts": {"Teeth*": {"upper": "head", "lower": "head/jaw"}}}))
    words = ["skin", str(face), "--joints", str(joints), "-o", str(out), "--picture", str(tmp_path / "w.png")]
    report = json.loads(done(capsys, *words, "--influences", "1", "--json", quiet=False))
    assert report["influences"] == 1
    assert report["joints"] == 2
    again = facepipe.open(out)
    recipe = again.parts().recipe
    assert recipe is not None
    assert recipe.verb == "skin"
    assert recipe.sources == ("./face.usdc", "./joints.json")
    assert "points = [" not in out.read_text()  # only what changed
    assert (tmp_path / "w.png").stat().st_size > 1000
    first = out.read_bytes()
    done(capsys, *words, "--influences", "1", "--force", quiet=False)
    assert out.read_bytes() == first
    for flags in (["--influences", "0"], ["--sharpness", "nan"]):
        assert run(capsys, *words, "--force", *flags)[0] == 2
    done(capsys, "skin", out, "--joints", joints, "-o", tmp_path / "again.usda", quiet=False)
    joints.write_text(json.dumps({"joints": {"other": {"position": [0, 0, 0]}}}))
    line = failed(capsys, "skin", out, "--joints", joints, "-o", tmp_path / "other.usda", folder=tmp_path)
    assert "has 2 joints, expected a face without" in line


def test_a_face_without_surface_is_refused() -> None:
    empty = replace(grid_mesh(), face_vertex_counts=np.zeros(0, np.int32), face_vertex_indices=np.zeros(0, np.int32))
    face = Face.from_parts(FaceParts(name="Cloud", meshes=(empty,)))
    with pytest.raises(InputError, match="no triangles"):
        SkinFace(joints=JointSet(joints=(JointSpec(path="a", position=(0, 0, 0)),)))(face)


def test_a_face_without_landmarks_is_skinned_with_a_warning() -> None:
    face = Face.from_parts(FaceParts(name="Sheet", meshes=(grid_mesh(),)))
    report = SkinFace(joints=JointSet(joints=(JointSpec(path="a", position=(0, 0, 0)),)))(face)
    assert report.warnings
    assert "landmarks" in report.warnings[0]
    assert (weights_of(Face(face.stage)) == 1).all()
