"""Animations in glTF files: the same poses as the rig's at the same times."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from facepipe_gltf.space import decompose, rotation_matrices
from faces import tiny_face
from gltf_export import (
    TOLERANCE,
    Writing,
    difference,
    head_height,
    random_coefficients,
    reference,
    to_gltf,
    writing,
    written,
)
from hypothesis import given
from hypothesis import strategies as st
from import_data import shared
from test_export_gltf import FACES

from facepipe.importers import load
from facepipe.parts import Animation, FaceParts
from facepipe.rig import build

__all__ = ["writing", "written"]

TIMES = np.array([0.0, 0.25, 1.0, 1.5])


def moving(parts: FaceParts, seed: int = 0, *, rigid: bool = False) -> Animation:
    """Random bone coefficients and weights at four times."""
    rng = np.random.default_rng(seed)
    coefficients = np.stack([random_coefficients(parts, rng, 0.1) for _ in TIMES])
    if rigid:
        coefficients[..., 6:] = 1.0
    shapes = ("mouthSmileLeft", "jawOpen")
    weights = np.array([[0.0, 0.1], [1.0, 0.9], [-0.3, 0.2], [0.5, 1.0]])
    return Animation(
        name="talk",
        times=TIMES,
        joints=parts.skeleton.joints,
        coefficients=coefficients,
        shapes=shapes,
        shape_weights=weights,
    )


@pytest.mark.parametrize("name", [name for name in FACES if name != "scaled rest"])
def test_keys_are_the_poses_of_the_rig(name: str, writing: Writing) -> None:
    parts = FACES[name]()
    animation = moving(parts, rigid=True)
    file, report = writing(replace(parts, animations=(animation,)), animations=True)
    assert animation.coefficients is not None
    assert animation.shape_weights is not None
    assert report.counts["animations"] == 1
    for time, coefficients, weights in zip(TIMES, animation.coefficients, animation.shape_weights, strict=True):
        expected = reference(parts, dict(zip(animation.shapes, weights, strict=True)), coefficients)
        assert difference(file.pose("talk", time), expected, parts) < TOLERANCE * head_height(parts)


def test_weights_between_keys_follow_the_inbetween_curves(writing: Writing) -> None:
    """Linear weights of a shape bend where it passes its inbetween: at 0.5, between keys."""
    parts = tiny_face()
    animation = replace(moving(parts), joints=(), coefficients=None)
    file, _ = writing(replace(parts, animations=(animation,)), animations=True)
    assert animation.shape_weights is not None
    assert len(file.key_times("talk")) > len(TIMES)
    for time in np.linspace(0, 1.5, 31):
        now = [np.interp(time, TIMES, track) for track in animation.shape_weights.T]
        weights = dict(zip(animation.shapes, map(float, now), strict=True))
        assert difference(file.pose("talk", time), reference(parts, weights), parts) < TOLERANCE * head_height(parts)


def test_authored_transforms_are_kept_and_joints_left_out_stay_at_rest(writing: Writing) -> None:
    parts = FACES["placed, Z up"]()
    rng = np.random.default_rng(2)
    rotations = rng.normal(size=(4, 1, 4))
    rotations /= np.linalg.norm(rotations, axis=-1, keepdims=True)
    scales = rng.uniform(-1.5, 1.5, (4, 1, 3))
    animation = Animation(
        name="turn", times=TIMES, joints=("root/jaw",), rotations=rotations, scales=scales, translations=None
    )
    file, _ = writing(replace(parts, animations=(animation,)), animations=True)
    rig = build(parts)
    for i, time in enumerate(TIMES):
        local = rig.rest.copy()
        local[1, :3, :3] = rotation_matrices(rotations[i, 0]) * scales[i, 0]
        expected = rig.split(rig.evaluate(joint_transforms=local) @ to_gltf(parts).T)
        assert difference(file.pose("turn", time), expected, parts) < TOLERANCE * head_height(parts)
    nodes = {file.list("nodes")[one["target"]["node"]]["name"] for one in file.animation("turn")["channels"]}
    assert nodes == {"jaw"}


def test_a_static_pose_has_one_key_and_a_rest_pose_keeps_its_name(writing: Writing) -> None:
    parts = tiny_face()
    coefficients = random_coefficients(parts, np.random.default_rng(1), 0.1)
    coefficients[:, 6:] = 1.0
    rest = np.concatenate([np.zeros((3, 6)), np.ones((3, 3))], axis=1)
    poses = tuple(
        Animation(name=name, joints=parts.skeleton.joints, coefficients=values[None])
        for name, values in (("frown", coefficients), ("rest", rest))
    )
    file, _ = writing(replace(parts, animations=poses), animations=True)
    assert file.key_times("frown").tolist() == [0.0]
    for name, values in (("frown", coefficients), ("rest", rest)):
        expected = reference(parts, {}, values)
        assert difference(file.pose(name, 0.0), expected, parts) < TOLERANCE * head_height(parts)


def test_shear_in_a_pose_is_reported(writing: Writing) -> None:
    """Rest is scaled, the pose turns after it: no TRS holds that."""
    parts = FACES["scaled rest"]()
    _, report = writing(replace(parts, animations=(moving(parts),)), animations=True)
    assert any(line.startswith("talk -> root: sheared local") for line in report.warnings)
    assert any(line.startswith("talk") and "inherited" in line for line in report.warnings)


def test_what_the_mode_leaves_out_is_left_out_of_animations_too(writing: Writing) -> None:
    parts = tiny_face()
    parts = replace(parts, animations=(moving(parts),))
    paths = {}
    for mode in ("skin", "morph", "both"):
        file, _ = writing(parts, f"{mode}.glb", mode=mode, animations=True)
        paths[mode] = {channel["target"]["path"] for channel in file.animation("talk")["channels"]}
    bones = {"translation", "rotation", "scale"}
    assert paths == {"skin": bones, "morph": {"weights"}, "both": bones | {"weights"}}
    file, report = writing(parts, "none.glb")
    assert not file.list("animations")
    assert any("animations" in line for line in report.dropped)


def test_error_of_fewer_influences_is_measured_over_the_poses(writing: Writing) -> None:
    """The report's figure is the largest distance between the poses of 4 influences and of all."""
    parts = load("makehuman", shared("makehuman/makehuman_head.npz")).parts
    parts = replace(parts, animations=parts.animations[:12])
    file, report = writing(parts, animations=True)
    rig = build(parts)
    worst = 0.0
    for animation in parts.animations:
        assert animation.coefficients is not None
        expected = rig.split(rig.evaluate(coefficients=animation.coefficients[0]) @ to_gltf(parts).T)
        worst = max(worst, difference(file.pose(animation.name, 0.0), expected, parts))
    assert report.error_mm == pytest.approx(worst * 1000, rel=1e-3)


@given(st.integers(0, 2**32 - 1), st.booleans())
def test_decomposed_matrices_come_back(seed: int, mirrored: bool) -> None:
    rng = np.random.default_rng(seed)
    q = rng.normal(size=(5, 4))
    scale = rng.uniform(0.05, 20, (5, 3)) * rng.choice([-1.0, 1.0], (5, 3) if mirrored else (5, 1))
    matrices = np.tile(np.eye(4), (5, 1, 1))
    matrices[:, :3, :3] = rotation_matrices(q) * scale[:, None, :]
    matrices[:, :3, 3] = rng.normal(size=(5, 3))
    trs = decompose(matrices)
    assert not trs.sheared.any()
    back = rotation_matrices(trs.rotation) * trs.scale[:, None, :]
    assert np.abs(back - matrices[:, :3, :3]).max() < 1e-9 * np.abs(scale).max()
    matrices[:, :3, :3] = matrices[:, :3, :3] @ np.array([[1, 0.3, 0], [0, 1, 0], [0, 0, 1]])
    assert decompose(matrices).sheared.all()
