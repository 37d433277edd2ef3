"""Joints of a file on a face: units, eyeballs, parts, and the joints and animations that the face has."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from skin_joints import TWO, bare, head, landmark_joints, skinned

from facepipe.core.errors import InputError
from facepipe.parts import Animation, Skeleton
from facepipe.rig import rest_coefficients
from facepipe.rig.animation import local_transforms
from facepipe.stage import Face
from facepipe.verbs.skin import JointSet, JointSpec, SkinFace
from facepipe.verbs.skin.surface import eyeballs_of, surface_of

Array = np.ndarray[Any, Any]


def test_wrong_units_are_warned_of() -> None:
    for parts, position, scale, message in (
        (replace(bare(), meters_per_unit=0.1), 0, 10.0, "from eye to eye"),
        (bare(), 0, 1.0, None),
        (bare(), 0, 40.0, "3 of 3 joints lie outside the face"),
        (bare(), 0, 0.05, "all 3 joints lie within"),
    ):
        places = np.array([[0.0, 60, 20], [0, 0, 15], [0, -40, 60]]) * scale + position
        joints = tuple(JointSpec(path="abc"[i], position=tuple(map(float, at))) for i, at in enumerate(places))
        report = skinned(parts, SkinFace(joints=JointSet(joints=joints, unit="mm")))[2]
        assert bool(report.warnings) == (message is not None)
        assert message is None or message in report.warnings[0]


def test_a_joint_of_a_lid_may_stand_in_the_eyeball() -> None:
    face = Face.from_parts(bare())
    whole = surface_of(face.parts(), "sample")
    joints = landmark_joints(face)
    centre = next(ball.centre for ball in eyeballs_of(whole) if ball.centre[0] > 0)
    lid = JointSpec(path="head/aLid", position=tuple(map(float, centre)), radius=40.0, regions=("eye_left_upper",))
    iris = JointSpec(path="head/eyeLeft/iris", position=tuple(map(float, centre + np.array([0, 0, 3]))))
    face, weights, report = skinned(bare(), SkinFace(joints=replace(joints, joints=(lid, *joints.joints, iris))))
    names = [joint.rpartition("/")[2] for joint in face.skeleton.joints]
    assert report.rigid["EyeballLeft"] == "head/eyeLeft"
    marks = bare().meshes[0].landmarks["multipie68"].indices
    assert weights[:, names.index("aLid")].max() > 0.05  # of the face: it has a region
    assert weights[marks[[46, 47]], names.index("aLid")].max() == 0
    assert not weights[:, names.index("iris")].any()  # in the eyeball, which another joint turns


def test_parts_that_are_the_face_itself_are_refused() -> None:
    with pytest.raises(InputError, match="'Head' matches no loose part"):
        SkinFace(joints=replace(TWO, parts={"Head": ("a", "a")}))(Face.from_parts(bare()))


def test_joints_keep_the_order_that_the_face_has_and_animations_what_they_do() -> None:
    nod = rest_coefficients(1)
    nod[0, 3] = 0.2
    pose = Animation(name="nod", joints=("root/neck/head",), coefficients=nod[None])
    sample = replace(head("sample"), animations=(*head("sample").animations, pose))
    face = Face.from_parts(sample)
    old, rng = face.skeleton, np.random.default_rng(0)
    shifts = np.array([0.0, 0.3, 0.1]) + rng.normal(0, 0.05, (len(old.joints), 3))
    places = (sample.skeleton.bind_transforms[:, :3, 3] + shifts) * face.mm_per_unit
    joints = tuple(
        JointSpec(path=joint, position=tuple(map(float, at)), rotation=tuple(map(float, turn / np.linalg.norm(turn))))
        for joint, at, turn in zip(old.joints, places, rng.normal(size=(len(old.joints), 4)), strict=True)
    )
    order = [joint.path for joint in JointSet(joints=joints).joints]
    assert order != list(sample.skeleton.joints)  # depth first there, parents of all before children here
    before = {one.name: one for one in face.animations}
    SkinFace(joints=JointSet(joints=joints[::-1], unit="mm"))(face)
    again = Face(face.stage)
    assert again.skeleton.joints == sample.skeleton.joints
    np.testing.assert_allclose(again.skeleton.bind_transforms[:, :3, 3], places / face.mm_per_unit, atol=1e-5)
    assert np.abs(again.skeleton.rest_transforms - old.rest_transforms).max() > 0.1
    assert sum(bool(one.joints) for one in again.animations) == 3
    for one in again.animations:
        for animation in (one, replace(one, coefficients=None)):  # what USD plays, too
            now = _relative(again.skeleton, animation)
            np.testing.assert_allclose(now, _relative(old, before[one.name]), atol=2e-3)  # scales of half precision


def test_weights_go_with_their_joints_where_the_face_has_another_order() -> None:
    specs = {spec.path: spec for spec in (*TWO.joints, JointSpec(path="a/c", position=(0, 40, 60)))}
    one, other = (
        JointSet(joints=tuple(map(specs.get, order)), unit="mm") for order in (("a", "a/b", "a/c"), ("a", "a/c", "a/b"))
    )
    first, expected, _ = skinned(bare(), SkinFace(joints=one))
    again, weights, _ = skinned(first.parts(), SkinFace(joints=other))
    assert again.skeleton.joints == ("a", "a/b", "a/c")
    assert np.abs(expected[:, 1] - expected[:, 2]).max() > 0.5
    np.testing.assert_array_equal(weights, expected)


def _relative(skeleton: Skeleton, animation: Animation) -> Array:
    """(T, j, 4, 4) what an animation does relative to rest."""
    rows = [skeleton.joints.index(joint) for joint in animation.joints]
    return np.asarray(np.linalg.inv(skeleton.rest_transforms[rows]) @ local_transforms(skeleton, animation))


def test_a_face_with_other_joints_is_refused_by_name() -> None:
    with pytest.raises(InputError, match=r"has 44 joints, .*'root' is on one side alone"):
        SkinFace(joints=TWO)(Face.from_parts(head("sample")))
