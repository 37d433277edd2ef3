"""Symmetric fits: the joints of both sides move as mirror images."""

from __future__ import annotations

import doctest
from dataclasses import replace

import numpy as np
import pytest
from bone_rigs import MM, face_joints, head, limits, random_pose, small
from faces import tiny_face

from facepipe.core.errors import InputError
from facepipe.core.names import mirrored_name
from facepipe.rig import Rig, build, rest_coefficients
from facepipe.verbs.fit_bones import skinning as module
from facepipe.verbs.fit_bones.bone_fit import BoneFit
from facepipe.verbs.fit_bones.skinning import symmetry

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
    fit = fit_of(rig)
    pose = fit.fit(rig.evaluate(coefficients=random_pose(rng, len(rig.joints), face_joints(rig)))).coefficients
    assert fit.fit(rig.evaluate(coefficients=pose)).largest * MM <= 0.01


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


def test_locks_off_rest_and_crooked_starts_are_mirrored() -> None:
    rig, rng = head(), np.random.default_rng(6)
    joints = face_joints(rig)
    lower, upper = limits(len(rig.joints), joints)
    left = next(joint for joint in joints if partner(rig, joint) > joint)
    lower[left, :4] = upper[left, :4] = 0.02
    target = rig.evaluate(coefficients=random_pose(rng, len(rig.joints), joints, 0.02))
    for sparsity in (0.0, 1.0):
        fit = fit_of(rig, lower=lower, upper=upper, sparsity=sparsity, steps=20)
        motion = moved(rig, fit.fit(target, start=random_pose(rng, len(rig.joints), joints)).coefficients)
        for joint in joints:
            np.testing.assert_allclose(motion[partner(rig, joint)], MIRROR @ motion[joint] @ MIRROR, atol=1e-6)


def test_sparse_fits_where_the_limits_of_one_side_leave_rest_out() -> None:
    rig = head()
    joints = face_joints(rig)
    lower, upper = limits(len(rig.joints), joints)
    left = next(joint for joint in joints if partner(rig, joint) > joint)
    lower[left, 0] = 1e-9
    found = fit_of(rig, lower=lower, upper=upper, sparsity=1e6).fit(rig.points)
    np.testing.assert_array_equal(np.abs(found.coefficients[[left, partner(rig, left)], 0]), 1e-9)


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


def test_partners_are_as_large_and_may_have_oblique_axes() -> None:
    rig = head()
    left = next(joint for joint in face_joints(rig) if partner(rig, joint) > joint)
    pair = [left, partner(rig, left)]
    rest = rig.rest.copy()
    worlds = rig.joint_worlds(rest)
    skewed = worlds[left] @ np.array([[1.0, 0.5, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 2.0, 0.0], [0, 0, 0, 1.0]])
    for joint, world in zip(pair, (skewed, MIRROR @ skewed @ MIRROR), strict=True):
        rest[joint] = np.linalg.solve(worlds[rig.parents[joint]], world)
    fit = fit_of(replace(rig, rest=rest))
    assert fit.symmetry is not None
    assert (fit.symmetry.leaders.reshape(-1, 9)[pair[1]] // 9 == left).all()
    rest[left, :3, :3] *= 1.5
    with pytest.raises(InputError, match="no mirror image"):
        fit_of(replace(rig, rest=rest))


def test_of_joints_of_one_name_partners_are_below_partners() -> None:
    """Two mouths, one in a mirrored half of the tree each, and names that hold a side without meaning it."""
    names = ("root", "root/arm_L", "root/arm_L/lip_R", "root/arm_L/lip_L", "root/arm_R", "root/arm_R/lip_R")
    names = (*names, "root/arm_R/lip_L", "root/upright_L", "root/upright_R", "root/lip_L")
    parents = np.array([-1, 0, 1, 1, 0, 4, 4, 0, 0, 0])
    rig = replace(small(), joints=names, parents=parents, rest=np.tile(np.eye(4), (10, 1, 1)))
    ties = symmetry(rig, np.ones(10, dtype=bool))
    leaders = ties.leaders.reshape(-1, 9)[:, 0] // 9
    assert leaders.tolist() == [0, 1, 2, 3, 1, 3, 2, 7, 7, 9]
    assert ties.single == ("root/lip_L",)


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
