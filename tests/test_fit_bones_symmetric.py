"""Symmetric fits: the joints of both sides move as mirror images."""

from __future__ import annotations

import doctest
from dataclasses import replace

import numpy as np
import pytest
from faces import tiny_face
from test_fit_bones_solver import MM, face_joints, head, limits, random_pose

from facepipe.errors import InputError
from facepipe.processors.fit_bones import symmetry as module
from facepipe.processors.fit_bones.session import BoneFit
from facepipe.processors.fit_bones.symmetry import mirrored_name
from facepipe.rig import Rig, build, rest_coefficients

MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])


def fit_of(rig: Rig, **settings: object) -> BoneFit:
    lower, upper = limits(len(rig.joints), face_joints(rig))
    known = {"lower": lower, "upper": upper, "threshold": 0.01 / MM, "rounds": 0, "symmetric": True} | settings
    return BoneFit(rig, **known)  # type: ignore[arg-type]


def partner(rig: Rig, joint: int) -> int:
    names = [path.rpartition("/")[2] for path in rig.joints]
    return names.index(mirrored_name(names[joint]))


def moved(rig: Rig, coefficients: np.ndarray) -> np.ndarray:
    """(m, 4, 4) what takes each joint from rest to its pose, in world space."""
    worlds = rig.joint_worlds(rig.local_transforms(coefficients))
    return worlds @ np.linalg.inv(rig.joint_worlds(rig.rest))


def test_a_mirrored_pose_of_joints_is_the_mirror_image_of_their_motion() -> None:
    rig, rng = head(), np.random.default_rng(0)
    target = rig.evaluate(coefficients=random_pose(rng, len(rig.joints), face_joints(rig)))
    found = fit_of(rig).fit(target)
    motion = moved(rig, found.coefficients)
    assert np.abs(found.coefficients - rest_coefficients(len(motion))).max() > 0.1
    for joint in face_joints(rig):
        np.testing.assert_allclose(motion[partner(rig, joint)], MIRROR @ motion[joint] @ MIRROR, atol=1e-6)


def test_symmetric_poses_are_recovered() -> None:
    rig, rng = head(), np.random.default_rng(1)
    for _ in range(3):
        pose = (
            fit_of(rig).fit(rig.evaluate(coefficients=random_pose(rng, len(rig.joints), face_joints(rig)))).coefficients
        )
        found = fit_of(rig).fit(rig.evaluate(coefficients=pose))
        assert found.largest * MM <= 0.01


def test_it_is_the_best_of_all_symmetric_poses_nearby() -> None:
    rig, rng = head(), np.random.default_rng(2)
    target = rig.evaluate(coefficients=random_pose(rng, len(rig.joints), face_joints(rig), 0.03))
    fit = fit_of(rig)
    found = fit.fit(target)
    x = fit.variables.reduced(found.coefficients)
    np.testing.assert_allclose(fit.variables.expanded(x, found.coefficients), found.coefficients, atol=1e-12)
    least = ((found.points - target) ** 2).sum()
    for _ in range(50):
        near = np.clip(x + rng.normal(0, 1e-3, len(x)), fit.variables.lower, fit.variables.upper)
        points = rig.evaluate(coefficients=fit.variables.expanded(near, found.coefficients))
        assert ((points - target) ** 2).sum() > least


def test_many_targets_and_sparse_fits_are_symmetric_too() -> None:
    rig, rng = head(), np.random.default_rng(3)
    joints = face_joints(rig)
    targets = [rig.evaluate(coefficients=random_pose(rng, len(rig.joints), joints, 0.02)) for _ in range(2)]
    found = [*fit_of(rig).fit_all(targets), fit_of(rig, sparsity=10.0).fit(targets[0])]
    for one in found:
        motion = moved(rig, one.coefficients)
        for joint in joints:
            np.testing.assert_allclose(motion[partner(rig, joint)], MIRROR @ motion[joint] @ MIRROR, atol=1e-6)


def test_limits_of_one_side_hold_on_the_other() -> None:
    rig, rng = head(), np.random.default_rng(4)
    joints = face_joints(rig)
    lower, upper = limits(len(rig.joints), joints)
    left = next(joint for joint in joints if partner(rig, joint) > joint)
    lower[left, 6:] = upper[left, 6:] = 1.0
    fit = fit_of(rig, lower=lower, upper=upper)
    found = fit.fit(rig.evaluate(coefficients=random_pose(rng, len(rig.joints), joints)))
    np.testing.assert_array_equal(found.coefficients[partner(rig, left), 6:], 1.0)
    assert ((found.coefficients >= fit.lower) & (found.coefficients <= fit.upper)).all()


def test_limits_without_a_mirrored_value_are_refused() -> None:
    rig = head()
    lower, upper = limits(len(rig.joints), face_joints(rig))
    left = next(joint for joint in face_joints(rig) if partner(rig, joint) > joint)
    lower[left, 6], upper[left, 6] = 1.1, 1.2
    lower[partner(rig, left), 6], upper[partner(rig, left), 6] = 0.8, 0.9
    with pytest.raises(InputError, match="sx: limits that are no mirror images"):
        fit_of(rig, lower=lower, upper=upper)
    lower, upper = limits(len(rig.joints), face_joints(rig))
    middle = next(joint for joint in face_joints(rig) if partner(rig, joint) == joint)
    lower[middle, :3] = 0.05
    with pytest.raises(InputError, match="limits without 0"):
        fit_of(rig, lower=lower, upper=upper)


def test_faces_without_mirrored_joints_are_refused() -> None:
    with pytest.raises(InputError, match="no pairs of joints"):
        BoneFit(build(tiny_face(0)), threshold=1.0, symmetric=True)
    rig = head()
    left = next(joint for joint in face_joints(rig) if partner(rig, joint) > joint)
    rest = rig.rest.copy()
    rest[left, :3, :3] = rest[left, :3, :3] @ np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    with pytest.raises(InputError, match="no mirror image"):
        fit_of(replace(rig, rest=rest))


def test_a_joint_without_a_partner_moves_as_it_likes() -> None:
    rig, rng = head(), np.random.default_rng(5)
    joints = face_joints(rig)
    left = next(joint for joint in joints if partner(rig, joint) > joint)
    names = list(rig.joints)
    names[partner(rig, left)] = names[partner(rig, left)].rpartition("/")[0] + "/other_R"
    fit = fit_of(replace(rig, joints=tuple(names)))
    assert fit.symmetry is not None
    assert set(fit.symmetry.single) == {names[left], names[partner(rig, left)]}
    found = fit.fit(rig.evaluate(coefficients=random_pose(rng, len(rig.joints), joints)))
    one, other = found.coefficients[left], found.coefficients[partner(rig, left)]
    assert np.abs(np.abs(one) - np.abs(other)).max() > 1e-3


def test_names_of_the_other_side() -> None:
    assert doctest.testmod(module).failed == 0
    for name in ("eye_L", "browInnerLeft", "r_lip.02", "Lid-l", "LEFT_EYE", "roll", "lip", "clavicle", "upperlip_l02"):
        assert mirrored_name(mirrored_name(name)) == name
    assert [mirrored_name(name) for name in ("roll", "lip", "clavicle")] == ["roll", "lip", "clavicle"]
