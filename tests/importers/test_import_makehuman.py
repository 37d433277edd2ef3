"""The MakeHuman importer against the formulas of its data, and against damaged input."""

from __future__ import annotations

import itertools
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from import_data import arrays, damaged, refused, shared, wrong_array
from packed_makehuman import PACKED, small_head

from facepipe.core.errors import InputError
from facepipe.importers import load
from facepipe.importers.makehuman import BASE_VERTICES, Options, read
from facepipe.importers.makehuman_rig import ARKIT_UNITS
from facepipe.importers.options import parse_targets
from facepipe.parts import Animation, FaceParts
from facepipe.rig import build, slide
from facepipe.rig.bone_coefficients import coefficient_matrices
from facepipe.rig.conventions import ARKIT_SHAPES

HEAD_HEIGHT = 2.86


@cache
def targeted() -> FaceParts:
    return read(shared(PACKED), Options(targets={"macro/caucasian-male-old": 0.8, "chin-width-incr": 1.0})).parts


@cache
def base() -> FaceParts:
    return load("makehuman", shared(PACKED)).parts


def expected_points(weights: dict[str, float]) -> np.ndarray:
    data = arrays(PACKED)
    points: np.ndarray = np.array(data["vertices"], dtype=np.float64)
    for name, weight in weights.items():
        target = data["target_names"].tolist().index(name)
        rows = slice(*data["target_offset"][target : target + 2])
        points[data["target_vertex"][rows]] += weight * data["target_delta"][rows].astype(np.float64)
    return points


def surface(points: np.ndarray) -> np.ndarray:
    """Points in the order of the face's meshes: kind after kind, without joint references."""
    kinds = arrays(PACKED)["vertex_kind"]
    return np.asarray(np.concatenate([points[kinds == kind] for kind in range(10)]))


def all_points(face: FaceParts) -> np.ndarray:
    return np.concatenate([mesh.points for mesh in face.meshes])


def test_meshes_and_targets_follow_the_formula() -> None:
    assert [mesh.name for mesh in base().meshes][:4] == ["Head", "EyeLeft", "EyeRight", "TeethUpper"]
    assert np.abs(all_points(base()) - surface(expected_points({}))).max() < 1e-9
    weights = {"macro/caucasian-male-old": 0.8, "chin/chin-width-incr": 1.0}
    assert np.abs(all_points(targeted()) - surface(expected_points(weights))).max() < 1e-6
    assert sum(len(mesh.face_vertex_counts) for mesh in base().meshes) == len(arrays(PACKED)["faces"])


def test_rest_of_the_base_is_the_packed_one() -> None:
    skeleton = base().skeleton
    assert np.abs(skeleton.bind_transforms - arrays(PACKED)["bone_rest_matrix"]).max() < 1e-5
    assert np.array_equal(skeleton.parents, arrays(PACKED)["bone_parent"])
    assert skeleton.joints[18] == "root/spine05/spine04/spine03/spine02/spine01/neck01/neck02/neck03/head/jaw"


def test_joints_after_targets_are_means_of_their_vertices() -> None:
    data = arrays(PACKED)
    points = expected_points({"macro/caucasian-male-old": 0.8, "chin/chin-width-incr": 1.0})
    offsets, vertices = data["bone_head_vertices_offset"], data["bone_head_vertices"]
    means = np.array([points[vertices[a:b]].mean(axis=0) for a, b in itertools.pairwise(offsets)])
    bind = targeted().skeleton.bind_transforms
    assert np.abs(bind[:, :3, 3] - means).max() < 1e-9
    assert np.abs(means - data["bone_head"]).max() > 0.1
    rotations = bind[:, :3, :3]
    assert np.abs(np.swapaxes(rotations, 1, 2) @ rotations - np.eye(3)).max() < 1e-9
    assert np.abs(np.linalg.det(rotations) - 1).max() < 1e-9


@pytest.mark.parametrize("face", [base, targeted])
def test_rest_transforms_chain_to_the_bind_transforms(face: Any) -> None:
    skeleton = face().skeleton
    assert np.abs(worlds(face(), skeleton.rest_transforms) - skeleton.bind_transforms).max() < 1e-9


def worlds(face: FaceParts, local: np.ndarray) -> np.ndarray:
    result: list[np.ndarray] = []
    for parent, matrix in zip(face.skeleton.parents, local, strict=True):
        result.append(matrix if parent < 0 else result[parent] @ matrix)
    return np.array(result)


def skinned(face: FaceParts, local: np.ndarray) -> np.ndarray:
    moves = worlds(face, local) @ np.linalg.inv(face.skeleton.bind_transforms)
    parts = []
    for mesh in face.meshes:
        assert mesh.skin is not None
        matrices = (moves[mesh.skin.joint_indices] * mesh.skin.joint_weights[..., None, None]).sum(axis=1)
        parts.append(np.einsum("nij,nj->ni", matrices[:, :3, :3], mesh.points) + matrices[:, :3, 3])
    return np.concatenate(parts)


def posed_by_formula(face: FaceParts, vectors: np.ndarray) -> np.ndarray:
    """v' = sum_b weight (q_b + G_b (v - head_b)), with G_b = G_p R_b and q_b = q_p + G_p (head_b - head_p)."""
    from scipy.spatial.transform import Rotation

    heads = face.skeleton.bind_transforms[:, :3, 3]
    turns = Rotation.from_rotvec(vectors.astype(np.float64)).as_matrix()
    G, q = turns.copy(), heads.copy()
    for bone, parent in enumerate(arrays(PACKED)["bone_parent"].tolist()):
        if parent >= 0:
            G[bone] = G[parent] @ turns[bone]
            q[bone] = q[parent] + G[parent] @ (heads[bone] - heads[parent])
    kinds = arrays(PACKED)["vertex_kind"]
    weights = np.concatenate([arrays(PACKED)["skin_weights"][kinds == kind] for kind in range(10)]).astype(np.float64)
    points = all_points(face)
    moved = np.zeros(points.shape)
    for b in np.flatnonzero(weights.any(axis=0)):
        moved += weights[:, b, None] * (q[b] + (points - heads[b]) @ G[b].T)
    return moved


def local_transforms(pose: Animation) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    assert pose.rotations is not None
    assert pose.translations is not None
    local = np.tile(np.eye(4), (len(pose.joints), 1, 1))
    local[:, :3, :3] = Rotation.from_quat(pose.rotations[0]).as_matrix()
    local[:, :3, 3] = pose.translations[0]
    return local


@pytest.mark.parametrize("face", [base, targeted])
def test_pose_units_move_points_as_the_formula_says(face: Any) -> None:
    poses = face().animations
    assert len(poses) == 60
    for pose, vectors in list(zip(poses, arrays(PACKED)["poseunit_rotvec"], strict=True))[::6]:
        local = local_transforms(pose)
        expected = posed_by_formula(face(), vectors)
        assert np.abs(skinned(face(), local) - expected).max() < 1e-5 * HEAD_HEIGHT, pose.name
        assert pose.coefficients is not None
        again = face().skeleton.rest_transforms @ coefficient_matrices(pose.coefficients[0])
        assert np.abs(again - local).max() < 1e-9, pose.name
    assert np.abs(skinned(face(), local_transforms(poses[0])) - all_points(face())).max() < 1e-5


@pytest.mark.parametrize("face", [base, targeted])
def test_sliders_turn_bones_as_pose_units_in_part(face: Any) -> None:
    """At v a pose unit turns each bone by v times its angle; a slider comes within 0.012 mm, at its end exactly."""
    parts, rig = face(), build(face())
    names, vectors = arrays(PACKED)["poseunit_names"].tolist(), arrays(PACKED)["poseunit_rotvec"].astype(np.float64)
    assert [one.name for one in parts.sliders] == names[1:]  # but for Rest
    for slider in parts.sliders[::4]:
        for value, most in ((0.07, 0.012), (0.55, 0.012), (1.0, 5e-4)):
            coefficients, _ = slide(parts.sliders, parts.skeleton.joints, {slider.name: value})
            expected = posed_by_formula(parts, value * vectors[names.index(slider.name)])
            assert 100 * np.abs(rig.evaluate(coefficients=coefficients) - expected).max() < most, slider.name


def test_sliders_have_mirrors_and_groups() -> None:
    sliders = {slider.name: slider for slider in base().sliders}
    mirrored = [name for name in sliders if ("Left" in name or "Right" in name)]
    for name in mirrored:
        assert sliders[sliders[name].mirror or ""].mirror == name
    assert sliders["LeftEyeturnRight"].mirror == "RightEyeturnLeft"
    assert [one.mirror for name, one in sliders.items() if name not in mirrored] == [None] * (59 - len(mirrored))
    assert {slider.group for slider in sliders.values()} == {
        "brows",
        "eyes",
        "nose",
        "cheeks",
        "tongue",
        "jaw",
        "mouth",
    }


def test_arkit_sliders_are_what_their_pose_units_do_together() -> None:
    parts = read(shared(PACKED), Options(sliders="arkit")).parts
    assert {slider.name for slider in parts.sliders} <= ARKIT_SHAPES
    assert {"jawOpen", "eyeBlinkLeft", "mouthSmileLeft", "mouthSmileRight", "tongueOut"} <= set(ARKIT_UNITS)
    assert {slider.name for slider in parts.sliders} == set(ARKIT_UNITS)
    units = {slider.name: slider for slider in base().sliders}
    by_name = {slider.name: slider for slider in parts.sliders}
    blink, closed = by_name["eyeBlinkLeft"].channels, units["LeftUpperLidClosed"].channels
    assert [one[:2] for one in blink] == [one[:2] for one in closed]
    assert [one[2] for one in blink] == pytest.approx([one[2] for one in closed], rel=1e-9)  # sums of other lengths
    assert by_name["eyeLookInRight"].mirror == "eyeLookInLeft"
    local = {animation.name: local_transforms(animation) for animation in base().animations}
    rest, rig = parts.skeleton.rest_transforms, build(parts)
    for name in ("mouthFunnel", "browInnerUp"):
        upper, lower = (np.linalg.solve(rest, local[unit]) for unit in ARKIT_UNITS[name])
        coefficients, _ = slide(parts.sliders, parts.skeleton.joints, {name: 1.0})
        expected = rig.evaluate(joint_transforms=rest @ upper @ lower)
        assert 100 * np.abs(rig.evaluate(coefficients=coefficients) - expected).max() < 5e-4
    eye = parts.skeleton.joints.index(next(joint for joint in parts.skeleton.joints if joint.endswith("eye_L")))
    ahead = []
    for name in ("eyeLookOutLeft", "eyeLookInLeft"):
        coefficients, _ = slide(parts.sliders, parts.skeleton.joints, {name: 1.0})
        world = rig.joint_worlds(rig.local_transforms(coefficients))[eye] @ np.linalg.inv(
            rig.joint_worlds(rig.rest)[eye]
        )
        ahead.append(world[:3, :3] @ (0.0, 0.0, 1.0))
    assert ahead[0][0] > 0.2 > -0.2 > ahead[1][0]  # x is the subject's left


def test_skin_weights_are_sorted_and_sum_to_one() -> None:
    data = arrays(PACKED)
    assert max(mesh.skin.joint_weights.shape[1] for mesh in base().meshes if mesh.skin) == 9
    dense = []
    for mesh in base().meshes:
        assert mesh.skin is not None
        weights, joints = mesh.skin.joint_weights, mesh.skin.joint_indices
        assert np.abs(weights.sum(axis=1) - 1).max() < 1e-12
        assert (np.diff(weights, axis=1) <= 0).all()
        assert (joints[weights == 0] == 0).all()
        full = np.zeros((len(weights), 77))
        np.put_along_axis(full, joints, weights, axis=1)
        full[:, 0] = 1 - full[:, 1:].sum(axis=1)  # unused slots point at joint 0
        dense.append(full)
    assert np.abs(np.concatenate(dense) - surface(data["skin_weights"])).max() < 1e-6


def test_regions_sum_to_one_and_hold_their_landmarks() -> None:
    for mesh in base().meshes:
        assert len(mesh.regions) == 9
        assert np.abs(sum(mesh.regions.values()) - 1).max() < 1e-9
        assert min(mask.min() for mask in mesh.regions.values()) >= 0
    head = base().meshes[0]
    marks = head.landmarks["multipie68"].indices
    stack = np.array([head.regions[name] for name in head.regions])
    strongest = np.array(list(head.regions))[stack[:, marks].argmax(axis=0)]
    assert set(strongest[17:27]) <= {"eyebrows", "eyes"}
    assert set(strongest[29:34]) == {"nose"}
    assert set(strongest[[37, 38, 43, 44]]) == {"eyes"}
    assert strongest[8] == "chin"


def test_landmarks_are_mirrored_in_pairs() -> None:
    head = base().meshes[0]
    marks = head.landmarks["multipie68"].indices
    assert len(set(marks.tolist())) == 68
    assert np.array_equal(arrays(PACKED)["source_vertex_index"][:4326][marks], BASE_VERTICES)
    pairs = [(i, 16 - i) for i in range(9)] + [(17 + i, 26 - i) for i in range(5)]
    pairs += [(i, i) for i in (27, 28, 29, 30, 33, 51, 57, 62, 66)] + [(31, 35), (32, 34)]
    pairs += [(36, 45), (37, 44), (38, 43), (39, 42), (40, 47), (41, 46)]
    pairs += [(48, 54), (49, 53), (50, 52), (59, 55), (58, 56), (60, 64), (61, 63), (67, 65)]
    assert {i for pair in pairs for i in pair} == set(range(68))
    places = head.points[marks]
    for right, left in pairs:
        assert np.abs(places[right] * (-1, 1, 1) - places[left]).max() < 1e-4, (right, left)
    assert (places[[0, 17, 36, 48], 0] < 0).all()


def test_shapes_are_the_named_targets() -> None:
    parts = read(shared(PACKED), Options(shapes="expression/caucasian/mouth-*,expression/asian/mouth-open")).parts
    names = {shape.name for mesh in parts.meshes for shape in mesh.blendshapes}
    assert {"mouth_compression", "expression_asian_mouth_open", "expression_caucasian_mouth_open"} <= names
    expected = expected_points({"expression/caucasian/mouth-open": 1.0})[:4326]
    head = parts.meshes[0]
    shape = next(shape for shape in head.blendshapes if shape.name == "expression_caucasian_mouth_open")
    points = head.points.copy()
    points[shape.point_indices] += shape.offsets
    assert np.abs(points - expected).max() < 1e-6
    assert not any(mesh.blendshapes for mesh in base().meshes)


def test_anchor_is_at_the_back_of_the_neck() -> None:
    head = base().meshes[0]
    assert head.anchor is not None
    x, y, z = head.points[head.anchor]
    assert abs(x) < 1e-3
    assert y < 6.2
    assert z < 0.2


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (Options(targets={"no-such": 1.0}), "is no target"),
        (Options(targets={"mouth-open": 1.0}), "fits 3 targets"),
        (Options(targets={"chin/chin-width-incr": float("nan")}), "finite"),
        (Options(shapes="nothing/*"), "fits no target"),
        (Options(meters_per_unit=0.0), "expected a number"),
    ],
)
def test_bad_options_are_refused(options: Options, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read(shared(PACKED), options)


def test_targets_on_the_command_line() -> None:
    assert parse_targets("nose/nose-point-up=0.5, chin-width-incr=1") == {
        "nose/nose-point-up": 0.5,
        "chin-width-incr": 1,
    }
    with pytest.raises(InputError, match="expected a number"):
        parse_targets("nose")


FUZZ = settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))


@FUZZ
@given(data=st.data())
def test_damaged_archives_raise_our_errors_only(tmp_path: Path, data: st.DataObject) -> None:
    shared(PACKED)
    file = tmp_path / "head.npz"
    file.write_bytes(data.draw(damaged(small_head())))
    refused(lambda: read(file, Options()), file)


@FUZZ
@given(data=st.data())
def test_wrong_arrays_raise_our_errors_only(tmp_path: Path, data: st.DataObject) -> None:
    shared(PACKED)
    content = dict(np.load(shared(PACKED)))
    name = data.draw(st.sampled_from(sorted(set(content) - {"target_vertex", "target_delta"})))
    content[name] = data.draw(wrong_array(content[name]))
    file = tmp_path / "head.npz"
    with file.open("wb") as stream:
        np.savez(stream, **content)
    refused(lambda: read(file, Options()), file)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04", b"\x93NUMPY", b"{}" * 50])
def test_no_archive_is_refused(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "head.npz"
    file.write_bytes(content)
    assert refused(lambda: read(file, Options()), file) is not None
