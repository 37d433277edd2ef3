"""Animations in glTF files: the same poses as the rig's at the same times."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import gltf_reader
import numpy as np
import pytest
from facepipe_gltf import Options, export
from facepipe_gltf import read as gltf
from faces import tiny_face
from gltf_builder import animated, make_model
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
from placed_faces import FACES
from pxr import Usd, UsdSkel

import facepipe
from facepipe.importers import load
from facepipe.parts import Animation, FaceParts
from facepipe.rig import build
from facepipe.rig.trs import decompose, rotation_matrices
from facepipe.stage import save_parts
from facepipe.stage.author import author

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
    assert report.warnings == (
        "root/jaw: shear inherited from scaled parents (2 joints); not every engine keeps it",
        "talk -> root: sheared local transform, nearest TRS kept",
        "talk -> root: shear inherited from scaled parents; not every engine keeps it",
    )


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


def test_clips_are_sampled_at_a_frame_rate_as_usd_draws_them(writing: Writing) -> None:
    parts = tiny_face()
    parts = replace(parts, animations=(moving(parts, rigid=True),), played="talk")
    file, report = writing(parts, animations=True, fps=8.0)
    stage = author(parts)
    cache = UsdSkel.Cache()
    cache.Populate(UsdSkel.Root(stage.GetDefaultPrim()), Usd.PrimDefaultPredicate)
    query = cache.GetSkelQuery(UsdSkel.Skeleton(stage.GetPrimAtPath("/Tiny/Skeleton")))
    names, rig = list(query.GetAnimQuery().GetBlendShapeOrder()), build(parts)
    frames = np.arange(13) / 8
    assert set(frames) <= set(file.key_times("talk"))
    for time in frames:
        code = time * stage.GetTimeCodesPerSecond()
        local = np.swapaxes(np.array(query.ComputeJointLocalTransforms(code)), 1, 2)
        weights = dict(zip(names, query.GetAnimQuery().ComputeBlendShapeWeights(code), strict=True))
        expected = rig.split(rig.evaluate(weights, joint_transforms=local) @ to_gltf(parts).T)
        assert difference(file.pose("talk", time), expected, parts) < TOLERANCE * head_height(parts)
    (line,) = (warning for warning in report.warnings if "sampled at 8 frames per second" in warning)
    assert line.endswith("off by at most nothing")  # all keys are on frames


def test_what_a_lower_frame_rate_costs_is_measured(writing: Writing) -> None:
    parts = tiny_face()
    blink = np.array([0.0, 0.0, 0.75, 0.0])
    clip = Animation(
        name="blink", times=np.array([0.0, 0.5, 0.75, 1.0]), shapes=("jawOpen",), shape_weights=blink[:, None]
    )
    _, report = writing(replace(parts, animations=(clip,)), animations=True, fps=2.0)
    assert report.warnings == ("blink: sampled at 2 frames per second: off by at most weights 0.75",)


def test_held_values_are_step_keys_and_come_back(tmp_path: Path) -> None:
    """A STEP channel of another tool's file is one again, with its own keys and values, after a way through USD."""
    builder, _, _ = animated(make_model())
    (tmp_path / "a.glb").write_bytes(builder.glb())
    parts = gltf.read(tmp_path / "a.glb", gltf.Options()).parts
    save_parts(parts, tmp_path / "a.usda")
    export(facepipe.open(tmp_path / "a.usda"), tmp_path / "b.glb", Options(animations=True))
    before, after = (gltf_reader.read(tmp_path / name) for name in ("a.glb", "b.glb"))
    found = []
    for file in (before, after):
        samplers = [one for one in file.animation("talk")["samplers"] if one["interpolation"] == "STEP"]
        assert len(samplers) == 1
        times, values = (file.decoded(samplers[0][key]) for key in ("input", "output"))
        changes = np.flatnonzero(np.append(True, np.abs(np.diff(values, axis=0)).max(axis=1) > 1e-3))
        found.append((times.ravel()[changes], values[changes]))
    np.testing.assert_allclose(found[0][0][1:], found[1][0][1:], atol=1e-6)  # the first is held before it too
    np.testing.assert_allclose(found[0][1], found[1][1], atol=1e-3)  # half precision of SkelAnimation
    again = gltf.read(tmp_path / "b.glb", gltf.Options()).parts.animations[0]
    assert again.times is not None
    assert parts.animations[0].times is not None
    np.testing.assert_allclose(again.times, parts.animations[0].times, atol=1e-6)
