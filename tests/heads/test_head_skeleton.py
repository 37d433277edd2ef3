"""Joints and weights of the head: they follow the person, and the jaw's rotation is its blendshape."""

from __future__ import annotations

import numpy as np
import pytest

from facepipe.geometry.balls import fit_ball
from facepipe.heads.assembly import make_head
from facepipe.heads.asset import asset
from facepipe.parts import FaceParts
from facepipe.rig import build
from facepipe.rig.bone_coefficients import rest_coefficients

MM = 0.1


@pytest.fixture(scope="module")
def average() -> FaceParts:
    return make_head(np.zeros(100))


def joint(parts: FaceParts, name: str) -> int:
    return next(i for i, path in enumerate(parts.skeleton.joints) if path.rpartition("/")[2] == name)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_eyes_turn_about_the_middle_of_their_balls(seed: int) -> None:
    parts = make_head(np.random.default_rng(seed).standard_normal(100))
    for side in ("Left", "Right"):
        ball = next(mesh.points for mesh in parts.meshes if mesh.name == f"Eyeball{side}")
        for name in ("eye", "lidUpper", "lidLower"):
            place = parts.skeleton.bind_transforms[joint(parts, name + side), :3, 3]
            assert np.linalg.norm(place - fit_ball(ball).centre) < 0.5 * MM


def test_a_stretched_head_has_stretched_joints(average: FaceParts) -> None:
    from facepipe.heads.assembly import skeleton

    stretch = np.array([1.1, 0.9, 1.2])
    points = np.concatenate([mesh.points for mesh in average.meshes])
    moved = skeleton(points * stretch).bind_transforms[:, :3, 3]
    np.testing.assert_allclose(moved, average.skeleton.bind_transforms[:, :3, 3] * stretch, atol=0.2 * MM)


def test_the_jaw_joint_opens_the_mouth_as_jaw_open_does(average: FaceParts) -> None:
    rig = build(average)
    coefficients = rest_coefficients(len(average.skeleton.joints))
    coefficients[joint(average, "jaw"), 3] = np.radians(25.3)
    turned = rig.evaluate(coefficients=coefficients) - rig.points
    opened = np.concatenate([asset().shapes["jawOpen"][1.0][part.points] for part in asset().parts.values()])
    size = np.linalg.norm(opened, axis=1)
    assert np.linalg.norm(turned - opened, axis=1)[size > 5 * MM].mean() < 0.15 * size[size > 5 * MM].mean()
    assert np.linalg.norm(turned, axis=1)[size == 0].max() < 1 * MM


def test_weights_are_alike_on_both_sides_and_sum_to_one(average: FaceParts) -> None:
    weights = np.asarray(build(average).influences.toarray())
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-6)
    assert 40 <= len(average.skeleton.joints) <= 80
    for i, path in enumerate(average.skeleton.joints):
        if path.endswith("Left"):
            twin = joint(average, path.rpartition("/")[2].replace("Left", "Right"))
            assert weights[:, i].sum() > 1.0
            assert abs(weights[:, i].sum() - weights[:, twin].sum()) < 0.1
