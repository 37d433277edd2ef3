"""Skeleton and weights of one face on another topology."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import done, failed
from faces import with_meshes
from hypothesis import given, settings
from hypothesis import strategies as st
from node import validate as khronos
from oracle import bake, difference, random_coefficients
from scipy.spatial.transform import Rotation
from skin_joints import ICT_KIND, head, retopologised, weights_of, without_joints

from facepipe.checks import validate_stage
from facepipe.core.errors import InputError
from facepipe.geometry.warp import fit_warp, nearest_rotations
from facepipe.registry import exporter
from facepipe.stage import Face, save_parts
from facepipe.verbs.skin import SkinFace, SkinOptions, SkinReport
from facepipe.verbs.skin.from_face import _sides
from facepipe.verbs.skin.surface import Slit, Surface, eyeballs_of, surface_of

Array = np.ndarray[Any, Any]
RNG = np.random.default_rng(4)


def landmarks(count: int = 30, seed: int = 0) -> tuple[Array, Array]:
    rng = np.random.default_rng(seed)
    source = rng.normal(scale=50, size=(count, 3))
    turned = 1.3 * source @ Rotation.from_rotvec(rng.normal(size=3)).as_matrix().T + rng.normal(scale=300, size=3)
    return source, turned + rng.normal(scale=3, size=(count, 3))


def test_a_warp_takes_landmarks_to_landmarks() -> None:
    source, target = landmarks()
    np.testing.assert_allclose(fit_warp(source, target).apply(source), target, atol=1e-9)
    smooth = fit_warp(source, target, 5.0)
    assert 0.01 < np.abs(smooth.apply(source) - target).max() < 10


def test_a_similarity_is_given_back_everywhere() -> None:
    source = landmarks()[0]
    matrix = Rotation.from_rotvec([0.3, -0.9, 0.4]).as_matrix()
    warp = fit_warp(source, 0.7 * source @ matrix.T + 5.0)
    far = RNG.normal(scale=1e4, size=(20, 3))
    np.testing.assert_allclose(warp.apply(far), 0.7 * far @ matrix.T + 5.0, atol=1e-6)
    np.testing.assert_allclose(nearest_rotations(warp.jacobians(far)), np.tile(matrix, (20, 1, 1)), atol=1e-9)


def test_far_away_a_warp_goes_over_into_its_similarity() -> None:
    source, target = landmarks()
    warp = fit_warp(source, target)
    far = RNG.normal(size=(20, 3))
    far *= 1e6 / np.linalg.norm(far, axis=1, keepdims=True)
    assert np.abs(warp.apply(far) - warp.similarity.apply(far)).max() < 100
    np.testing.assert_allclose(
        warp.jacobians(far), np.tile(warp.similarity.scale * warp.similarity.rotation, (20, 1, 1)), atol=1e-3
    )


@given(st.integers(0, 20))
@settings(deadline=None, max_examples=10)
def test_jacobians_are_those_of_finite_differences(seed: int) -> None:
    warp = fit_warp(*landmarks(seed=seed))
    at, step = np.random.default_rng(seed).normal(scale=60, size=(5, 3)), 1e-4
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        slope = (warp.apply(at + shift) - warp.apply(at - shift)) / (2 * step)
        np.testing.assert_allclose(warp.jacobians(at)[:, :, axis], slope, atol=1e-5)


@cache
def transferred(kind: str) -> tuple[Face, SkinReport]:
    face = Face.from_parts(without_joints(head(kind)))
    report = SkinFace(source=Face.from_parts(head("makehuman")))(face)
    return Face(face.stage), report


@cache
def surface(kind: str) -> Surface:
    return surface_of(transferred(kind)[0].parts(), kind)


def joint(face: Face, name: str) -> int:
    return [path.rpartition("/")[2] for path in face.skeleton.joints].index(name)


def column(kind: str, *names: str) -> Array:
    """(m,) weights of joints together at the sewn points."""
    face = transferred(kind)[0]
    place = np.unique(surface(kind).group, return_index=True)[1]
    return np.asarray(weights_of(face)[place][:, [joint(face, name) for name in names]].sum(axis=1))


def opened(face: Face, angle: float = 0.3) -> Array:
    """(n,) mm that points move when the jaw turns about the world's x axis."""
    number = joint(face, "jaw")
    worlds = face.rig().joint_worlds(face.rig().rest)
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([angle, 0, 0]).as_matrix()
    to_joint = np.linalg.inv(worlds[number]) @ np.block(
        [[np.eye(3), worlds[number, :3, 3:]], [np.zeros((1, 3)), np.ones((1, 1))]]
    )
    local = face.rig().rest.copy()
    local[number] = local[number] @ to_joint @ turn @ np.linalg.inv(to_joint)
    return np.asarray(
        np.linalg.norm(face.evaluate(joint_transforms=local) - face.evaluate(), axis=1) * face.mm_per_unit
    )


def test_onto_itself_a_face_gets_its_own_weights_and_joints() -> None:
    source = Face.from_parts(retopologised(head("makehuman")))
    face = Face.from_parts(without_joints(head("makehuman")))
    report = SkinFace(source=source, options=SkinOptions(influences=9))(face)
    again = Face(face.stage)
    found, own = weights_of(again), weights_of(source)
    assert np.sqrt(((found - own) ** 2).sum(axis=1).mean()) < 0.002
    rigid = np.concatenate(
        [np.full(len(mesh.points), mesh.name.startswith(("Eye", "Teeth"))) for mesh in source.meshes]
    )
    assert np.abs(found - own)[~rigid].max() <= 1.1e-3  # less than a thousandth is left out
    assert np.abs(found - own)[rigid].max() < 0.05  # eyeballs and teeth are made rigid
    np.testing.assert_allclose(again.skeleton.bind_transforms, source.skeleton.bind_transforms, atol=1e-6)
    assert report.transfer is not None
    assert report.transfer.surface_mm["max"] < 1e-9


@pytest.mark.parametrize("kind", ["sample", ICT_KIND])
def test_transferred_weights_are_smooth_shares_of_few_joints(kind: str) -> None:
    face, report = transferred(kind)
    weights = weights_of(face)
    assert weights.min() >= 0
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-6)
    assert (weights > 0).sum(axis=1).max() == report.influences == 4
    assert report.largest_step_per_mm < 0.45


@pytest.mark.parametrize("kind", ["sample", ICT_KIND])
def test_joints_lie_where_the_anatomy_has_them(kind: str) -> None:
    face, report = transferred(kind)
    at = face.skeleton.bind_transforms[:, :3, 3] * face.mm_per_unit
    balls = {ball.centre[0] > 0: ball.centre for ball in eyeballs_of(surface(kind))}
    for side, left in (("L", True), ("R", False)):
        assert np.linalg.norm(at[joint(face, f"eye_{side}")] - balls[left]) < 2
    marks = surface(kind).landmarks
    assert marks is not None
    marked = surface(kind).points[marks]
    ears, chin = marked[[0, 16]].mean(axis=0), marked[8]
    jaw = at[joint(face, "jaw")]
    assert abs(jaw[0]) < 1
    assert np.linalg.norm((jaw - ears)[1:]) < 0.5 * np.linalg.norm((chin - ears)[1:])  # beside the ears, not the chin
    np.testing.assert_allclose(at[joint(face, "levator05_L")] * [-1, 1, 1], at[joint(face, "levator05_R")], atol=1.0)
    axes = face.skeleton.bind_transforms[:, :3, :3]
    np.testing.assert_allclose(axes @ axes.transpose(0, 2, 1), np.tile(np.eye(3), (len(axes), 1, 1)), atol=1e-6)
    assert report.transfer is not None
    assert report.transfer.eyeballs == 2
    assert report.transfer.landmarks_mm < 2


@pytest.mark.parametrize("kind", ["sample", ICT_KIND])
def test_lips_and_lids_never_swap(kind: str) -> None:
    marks = surface(kind).landmarks
    assert marks is not None
    upper, lower = marks[[50, 51, 52, 61, 62, 63]], marks[[56, 57, 58, 65, 66, 67]]
    below = column(kind, "jaw", "oris01", "oris07_L", "oris07_R")
    above = column(kind, "oris05", "oris03_L", "oris03_R")
    assert below[upper].max() < 1e-3
    assert above[lower].max() < 1e-3
    assert below[lower].min() > 0.3
    assert above[upper].min() > 0.3
    for side, over, under in (("R", [37, 38], [40, 41]), ("L", [43, 44], [46, 47])):
        lid, other = column(kind, f"orbicularis03_{side}"), column(kind, f"orbicularis04_{side}")
        assert lid[marks[over]].min() > 0.5
        assert lid[marks[under]].max() < 2e-3
        assert other[marks[under]].min() > 0.5
        assert other[marks[over]].max() < 1e-3


@pytest.mark.parametrize("kind", ["sample", ICT_KIND])
def test_the_jaw_bone_opens_the_mouth(kind: str) -> None:
    face = transferred(kind)[0]
    whole, moved = surface(kind), opened(face)
    at = moved[np.unique(whole.group, return_index=True)[1]]
    marks = whole.landmarks
    assert marks is not None
    assert at[marks[8]] > 15
    assert at[marks[[27, 30, 33, 50, 51, 52, 61, 62, 63, 36, 45]]].max() < 0.05
    teeth = whole.mesh == whole.mesh_names.index("Teeth")
    middle = whole.points[teeth, 1].mean()
    for number in np.unique(whole.component[teeth]):
        own = whole.component == number
        low = whole.points[own, 1].mean() < middle
        assert (at[own].min() > 10) if low else (at[own].max() < 0.01)
    assert face.name


@pytest.mark.parametrize("kind", ["sample", ICT_KIND])
def test_the_result_is_valid_and_deforms_as_usd_says(kind: str, tmp_path: Path) -> None:
    face = transferred(kind)[0]
    face.save(tmp_path / "rigged.usdc")
    assert not validate_stage(tmp_path / "rigged.usdc")
    pose = face.rig().local_transforms(random_coefficients(np.random.default_rng(1), 77, 0.2, 0.2))
    shapes = {"jawOpen": 0.6}
    assert difference(face, face.evaluate(shapes, joint_transforms=pose), bake(face, shapes, pose)) < 1e-5
    glb = exporter("head.glb")
    report = glb.export(face, tmp_path / "head.glb", glb.Options(shapes="jawOpen"))
    assert report.counts["joints"] == 77
    issues = khronos([tmp_path / "head.glb"])[tmp_path / "head.glb"]["issues"]
    assert issues["numErrors"] == issues["numWarnings"] == 0


def test_units_and_axes_of_the_faces_do_not_matter() -> None:
    source = retopologised(head("sample"))
    turn = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    meshes = tuple(replace(mesh, transform=turn @ np.diag([2.5, 2.5, 2.5, 1.0])) for mesh in head("sample").meshes)
    bare = without_joints(replace(source, meshes=meshes, meters_per_unit=0.001, up_axis="Z"))
    face = Face.from_parts(with_meshes(bare, blendshapes=()))
    SkinFace(source=Face.from_parts(source), options=SkinOptions(influences=8))(face)
    again = Face(face.stage)
    assert np.abs(weights_of(again) - weights_of(Face.from_parts(source))).max() < 0.05
    expected = turn[:3, :3] @ source.skeleton.bind_transforms[:, :3, 3].T * 2.5
    np.testing.assert_allclose(again.skeleton.bind_transforms[:, :3, 3], expected.T, atol=1e-4)


def test_faces_that_cannot_are_refused_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sample = head("sample")
    blind = with_meshes(sample, landmarks={})
    for name, parts in {"rigged": sample, "bare": without_joints(sample), "blind": blind}.items():
        save_parts(parts, tmp_path / f"{name}.usdc")
    save_parts(without_joints(blind), tmp_path / "both.usdc")
    for target, source, message in (
        ("bare", "bare", "no joints with skin weights"),
        ("bare", "blind", "blind.usdc -> </Face>: no 68 landmarks"),
        ("both", "rigged", "no 68 landmarks"),
    ):
        files = (tmp_path / f"{target}.usdc", "--from", tmp_path / f"{source}.usdc", "-o", tmp_path / "out.usdc")
        assert message in failed(capsys, "skin", *files, folder=tmp_path)
    words = ("skin", tmp_path / "bare.usdc", "--from", tmp_path / "rigged.usdc")
    assert "mm from their own" in done(capsys, *words, "-o", tmp_path / "out.usdc", quiet=False)
    line = failed(capsys, *words, "--joints", words[1], "-o", tmp_path / "out.usdc", "--force", folder=tmp_path)
    assert "expected one of them (--joints, --from, --learn-from)" in line
    with pytest.raises(InputError, match="expected one of them"):
        SkinFace()


def test_points_beside_a_slit_look_on_their_own_side_only() -> None:
    side = np.array([0.5, -0.5, 0.5, 0.05])  # above, below, above but far off, almost on the line
    distance = np.array([1.0, 1.0, 50.0, 1.0])
    slit = Slit(name="mouth", width=40.0, side=side, distance=distance)
    triangles = np.array([[0, 0, 2], [1, 1, 2], [3, 3, 3]])  # above, below, beside a corner
    other = Slit(name="mouth", width=40.0, side=np.array([0.5, -0.5, 0.0, 0.0]), distance=np.zeros(4))
    sides = _sides([slit], [other], np.arange(4), triangles)
    assert [(points.tolist(), allowed.tolist()) for points, allowed in sides] == [
        ([0], [0, 2]),
        ([1], [1, 2]),
        ([2, 3], [0, 1, 2]),
    ]
