"""Weights beyond 0..1 exaggerate what sources differ by, and leave a rig that is one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from blend_faces import head_height, session, steady, weighted
from command_line import Capsys, done, run
from hypothesis import given, settings
from hypothesis import strategies as st

from facepipe.parts import Skin
from facepipe.performing import read_kept
from facepipe.rig.trs import compose, rotation_matrices
from facepipe.verbs.blend import BlendFaces, Weights
from facepipe.verbs.blend.result import result_parts
from facepipe.verbs.blend.rigs import blend_linear, blend_skins

BEYOND = (-0.5, 1.5)


def turned(degrees: float) -> np.ndarray:
    """(3, 3) about z."""
    half = np.radians(degrees) / 2
    return rotation_matrices(np.array([0.0, 0.0, np.sin(half), np.cos(half)]))


def test_the_neutral_and_shapes_go_on_along_the_way_from_one_source_to_the_other() -> None:
    blend = session("sample", 2)
    solution = blend.solve(Weights(default=BEYOND))
    free = np.setdiff1d(np.arange(blend.sources.points.shape[1]), blend.kept.points)
    expected = weighted(np.array(BEYOND), blend.sources.points)
    steady((solution.neutral.points - expected)[free], 1e-6 * head_height(blend))
    for sculpt, offsets in zip(solution.sculpts, solution.offsets, strict=True):
        if not np.isin(sculpt.points, blend.kept.points).any():
            np.testing.assert_allclose(offsets, weighted(np.array(BEYOND), sculpt.offsets), atol=1e-6)


def test_a_caricature_in_one_region_has_joints_and_skin_that_pose() -> None:
    blend = session("sample", 2)
    solution = blend.solve(Weights(regions={"nose": (-1.0, 2.0), "mouth": (2.0, -1.0)}, default=BEYOND))
    assert (solution.neutral.shares < -0.5).any()
    parts = result_parts(blend, solution)
    for transforms in (parts.skeleton.bind_transforms, parts.skeleton.rest_transforms):
        linear = transforms[:, :3, :3]
        np.testing.assert_allclose(
            np.swapaxes(linear, 1, 2) @ linear, np.broadcast_to(np.eye(3), linear.shape), atol=1e-6
        )
        assert (np.linalg.det(linear) > 0).all()
    for mesh in parts.meshes:
        if mesh.skin is not None:
            assert (mesh.skin.joint_weights >= 0).all()
            np.testing.assert_allclose(np.asarray(mesh.skin.joint_weights, np.float64).sum(axis=1), 1.0, atol=1e-6)
        if mesh.normals is not None:
            np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-6)


def test_turns_and_scales_of_joints_go_on() -> None:
    matrices = np.stack([[turned(10.0), np.diag([1.0, 1, 3])], [turned(30.0) * 2.0, np.eye(3)]])
    result = blend_linear(matrices, np.array([BEYOND, (-1.0, 2.0)]))
    np.testing.assert_allclose(result[0], turned(40.0) * 2.0**1.5, atol=1e-12)
    np.testing.assert_allclose(result[1], np.diag([1.0, 1, 1 / 3]), atol=1e-12)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10**6))
def test_joints_are_neither_flat_nor_mirrored(seed: int) -> None:
    """Of sources turned by anything and scaled by 1/4 to 4; and shares that are hardly below 0 change little."""
    rng = np.random.default_rng(seed)
    scales = np.exp2(rng.uniform(-2, 2, (3, 8, 3)))
    matrices = compose(np.zeros((3, 8, 3)), rng.normal(size=(3, 8, 4)), scales)[..., :3, :3]
    shares = rng.uniform(-1, 1, (8, 3))
    shares[:, 0] = 1 - shares[:, 1:].sum(axis=1)
    found = blend_linear(matrices, shares)
    assert (np.linalg.det(found) > 0).all()
    lengths, beyond = np.linalg.norm(found, axis=1), (shares < 0).any(axis=1)
    powers = np.exp(np.einsum("jk,kja->ja", shares, np.log(scales)))
    np.testing.assert_allclose(lengths[beyond], powers[beyond], rtol=1e-9)
    one = np.tile([1e-9, 1 + 1e-9, -2e-9], (8, 1))
    np.testing.assert_allclose(blend_linear(matrices, one), matrices[1], atol=1e-6)


def test_skin_weights_stay_shares() -> None:
    rng = np.random.default_rng(0)
    dense = rng.dirichlet(np.full(3, 0.5), (2, 40))
    indices = np.tile(np.arange(3, dtype=np.int32), (40, 1))
    skins = [Skin(joint_indices=indices, joint_weights=one) for one in dense]
    blended = blend_skins([*skins, None], np.tile([*BEYOND, 0.0], (40, 1)))
    assert blended is not None
    found = np.zeros((40, 3))
    np.add.at(found, (np.arange(40)[:, None], blended.joint_indices), blended.joint_weights)
    one = np.einsum("k,knj->nj", BEYOND, np.asarray(dense, np.float32).astype(np.float64))
    assert (one < -0.01).any()
    clipped = np.maximum(one, 0.0)
    np.testing.assert_allclose(found, clipped / clipped.sum(axis=1, keepdims=True), atol=1e-9)
    left = blend_skins([*skins, None], np.tile([-0.5, -0.5, 2.0], (40, 1)))
    assert left is not None
    np.testing.assert_allclose(left.joint_weights.sum(axis=1), 1.0, atol=1e-6)


def test_weights_are_bounded_once_they_sum_to_one() -> None:
    shares = Weights(regions={"mouth": (-1, 3)}, default=(4, -1)).shares(("mouth",), 2)
    np.testing.assert_allclose(shares.table, [[-0.5, 1.5], [4 / 3, -1 / 3]])
    assert [note for note in shares.notes if "caricature" in note] == [
        "weights of mouth go beyond 0..1: caricature",
        "weights of default go beyond 0..1: caricature",
    ]
    assert not any("caricature" in note for note in Weights(default=(0, 1)).shares(("mouth",), 2).notes)


@pytest.mark.parametrize("words", [("--default=-0.5,1.5",), ("--default", "-.5,1.5"), ("--set=neck=-0.5,1.5",)])
def test_a_number_below_0_is_no_flag(folder: Path, capsys: Capsys, words: tuple[str, ...]) -> None:
    code, _, err = run(capsys, "blend", "a.usda", "b.usda", "-o", "c.usda", *words)
    assert (code, "go beyond 0..1: caricature" in err) == (0, True)
    weights = read_kept("c.usda", BlendFaces).values["weights"]
    assert BEYOND in (weights.default, weights.regions.get("neck"))
    before = Path("c.usda").read_bytes()
    done(capsys, "blend", "--edit", "c.usda", "--force", "-q")
    assert Path("c.usda").read_bytes() == before
