"""Neural rigs on faces: sliders, network and shapes that do what the neural rig does."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
from faces import with_head
from neural_faces import CONTROLS, face, millimetres, neural_rig, random_values

from facepipe.core.errors import InputError, TopologyError
from facepipe.neural import AttachNeuralRig, AttachOptions, with_neural_rig
from facepipe.parts import Animation, Blendshape, FaceParts
from facepipe.rig import (
    build,
    coefficient_matrices,
    rest_coefficients,
    sample_transforms,
    sample_weights,
    slide,
)
from facepipe.rig.neural_rig import NeuralRig, with_influences
from facepipe.verbs.whole_faces import MILLIMETRES, world_to_world

PLACES: tuple[tuple[Literal["Y", "Z"], float], ...] = (("Y", 0.01), ("Z", 1.0), ("Z", 0.001))


@pytest.mark.parametrize("kind", ["bones", "points", "points without joints"])
@pytest.mark.parametrize(("up_axis", "unit"), PLACES)
def test_the_face_does_what_the_neural_rig_does(up_axis: Literal["Y", "Z"], unit: float, kind: str) -> None:
    parts = face(up_axis, unit, joints=kind != "points without joints")
    rig = neural_rig(parts, bones=kind == "bones")
    values = random_values(rig, 20)
    expected = rig.points(values)
    assert np.ptp(expected, axis=0).max() > 0.02 * np.ptp(rig.rest)
    attached = AttachNeuralRig(options=AttachOptions(offset_tolerance_mm=1e-4))(parts, rig, "face")
    off = np.abs(millimetres(attached.parts, rig, values) - expected).max()
    assert off < 1e-4 + 2.0 * attached.dropped_mm
    assert off < 1e-4
    largest = np.abs(
        [
            slide(
                attached.parts.sliders,
                attached.parts.skeleton.joints,
                {one.name: value for one, value in zip(rig.controls, row, strict=True)},
                attached.parts.slider_network,
            )[1]["neural_000"]
            for row in values
        ]
    ).max()
    assert 0.1 < largest < 1.5


@pytest.mark.parametrize("bones", [True, False])
def test_points_left_out_of_shapes_are_reported(bones: bool) -> None:
    parts = face()
    rig = neural_rig(parts, bones=bones)
    values = random_values(rig, 30)
    whole = AttachNeuralRig(options=AttachOptions(offset_tolerance_mm=0.0))(parts, rig, "face")
    some = AttachNeuralRig(options=AttachOptions(offset_tolerance_mm=1.0))(parts, rig, "face")
    assert (whole.dropped_mm, whole.offsets) == (0.0, rig.shapes.shape[0] * rig.shapes.shape[1])
    assert some.offsets < whole.offsets
    off = np.linalg.norm(millimetres(some.parts, rig, values) - rig.points(values), axis=2).max()
    assert 0.0 < off < 3.0 * some.dropped_mm  # bones scale what is left out


def test_what_the_face_has_stays() -> None:
    parts = face()
    rig = neural_rig(parts, bones=True)
    found = with_neural_rig(parts, rig, "face")
    assert found.skeleton == parts.skeleton
    for before, after in zip(parts.meshes, found.meshes, strict=True):
        assert after.points is before.points
        assert (after.skin, after.regions, after.uv_sets) == (before.skin, before.regions, before.uv_sets)
    assert [(slider.name, slider.minimum, slider.maximum, slider.default) for slider in found.sliders[:-1]] == [
        (one.name, one.minimum, one.maximum, one.default) for one in CONTROLS
    ]
    assert found.sliders[-1] == parts.sliders[1]  # no control of the rig
    lip = found.sliders[1]
    assert (lip.group, lip.value) == ("mouth", 0.5)


@pytest.mark.parametrize("tolerance_mm", [0.0, 0.01])
def test_shapes_that_move_nothing_are_no_shapes(tolerance_mm: float) -> None:
    parts = face()
    rig = neural_rig(parts, bones=True)
    still = replace(rig, shapes=rig.shapes * np.array([1.0, 0.0, 1.0, 1.0])[:, None, None])
    found = AttachNeuralRig(options=AttachOptions(offset_tolerance_mm=tolerance_mm))(parts, still, "face").parts
    own = [shape.name for shape in parts.meshes[0].blendshapes]
    assert [shape.name for shape in found.meshes[0].blendshapes] == [*own, "neural_000", "neural_001", "neural_002"]
    values = random_values(still, 5)
    assert np.abs(millimetres(found, still, values) - still.points(values)).max() < 1e-4


def bent(parts: FaceParts) -> FaceParts:
    """The face with its joints away from bind at rest, a clip that turns all of them and plays shapes, and a pose."""
    skeleton, random = parts.skeleton, np.random.default_rng(3)
    if not skeleton.joints:
        weights = random.random((4, 2))
        clip = Animation(name="Talk", times=np.arange(4.0), shapes=("jawOpen", "mouthSmileLeft"), shape_weights=weights)
        return replace(parts, animations=(clip,))
    coefficients = np.tile(rest_coefficients(len(skeleton.joints)), (5, 1, 1))
    coefficients += 0.2 * random.normal(size=coefficients.shape)
    rest = skeleton.rest_transforms @ coefficient_matrices(coefficients[0])
    clip = Animation(
        name="Talk",
        times=np.arange(4.0),
        joints=skeleton.joints,
        coefficients=coefficients[1:],
        shapes=("jawOpen", "mouthSmileLeft"),
        shape_weights=random.random((4, 2)),
    )
    pose = replace(clip, name="Pose", times=None, coefficients=coefficients[2:3], shapes=(), shape_weights=None)
    return replace(parts, skeleton=replace(skeleton, rest_transforms=rest), animations=(clip, pose))


def at_own_rest(parts: FaceParts, rig: NeuralRig) -> NeuralRig:
    """A rig without bones with the face's points at rest, and without motion at its defaults."""
    if rig.bones is not None:
        return rig
    to = world_to_world(parts.meters_per_unit, parts.up_axis, MILLIMETRES)
    return replace(rig, rest=build(parts).evaluate() @ to[:3, :3].T)


@pytest.mark.parametrize("kind", ["bones", "bones of two a point", "points", "points without joints"])
def test_shapes_and_clips_of_the_face_play_as_before(kind: str) -> None:
    parts = bent(face("Z", 0.001, joints=kind != "points without joints"))
    rig = at_own_rest(parts, neural_rig(parts, bones="bones" in kind))
    fewer = kind == "bones of two a point"
    if fewer and rig.bones is not None:
        rig = replace(rig, bones=with_influences(rig.bones, 2))
    attached = AttachNeuralRig()(parts, rig, "face")
    before, after, height = build(parts), build(attached.parts), np.ptp(rig.rest)
    assert attached.warnings == ()
    if fewer:
        assert (np.diff(before.influences.indptr).max(), np.diff(after.influences.indptr).max()) == (3, 2)
    for weights in () if fewer else ({"jawOpen": 0.4}, {"jawOpen": 1.0}, {"mouthSmileLeft": -0.5}):
        assert np.abs(after.evaluate(weights) - before.evaluate(weights)).max() < 1e-5 * height
    assert [(one.name, one.joints) for one in attached.parts.animations] == [
        (one.name, one.joints) for one in parts.animations
    ]
    for old, new in zip(parts.animations, attached.parts.animations, strict=True):
        for number in range(1 if old.times is None else len(old.times)):
            points = [
                one.evaluate(
                    sample_weights(animation, number),
                    joint_transforms=sample_transforms(parts.skeleton, animation, number),
                )
                for one, animation in ((before, old), (after, new))
            ]
            assert np.abs(points[1] - points[0]).max() < 1.5 * attached.clips_mm + 1e-5 * height
    assert (attached.clips_mm > 0) == (kind in ("points", "bones of two a point"))
    assert attached.clips_mm < 0.1


def test_clips_that_bones_play_need_no_further_shapes() -> None:
    parts = face()
    bones = parts.skeleton.joints
    still = Animation(name="Rest", joints=bones, coefficients=rest_coefficients(len(bones))[None])
    parts = replace(parts, animations=(still,))
    rig = neural_rig(parts, bones=True)
    assert rig.bones is not None
    found = AttachNeuralRig()(parts, replace(rig, bones=with_influences(rig.bones, 2)), "face")
    assert not any(shape.name.startswith("clip_") for mesh in found.parts.meshes for shape in mesh.blendshapes)
    assert not any(name.startswith("clip_") for name in found.parts.animations[0].shapes)
    assert np.abs(found.parts.animations[0].shape_weights).max() < 1e-6
    assert found.clips_mm < 1e-4


def test_smaller_files_are_asked_for_and_what_goes_is_named() -> None:
    parts = bent(face())
    options = AttachOptions(keep_shapes=False)
    found = AttachNeuralRig(options=options)(parts, neural_rig(parts, bones=True), "face")
    names = {shape.name for mesh in found.parts.meshes for shape in mesh.blendshapes}
    assert names == {f"neural_{number:03d}" for number in range(4)}
    assert [animation.name for animation in found.parts.animations] == ["Pose"]
    assert found.warnings == ("left out: clips that play shapes which are not kept: Talk",)


def test_a_rig_in_place_of_another_leaves_nothing_of_it() -> None:
    parts = bent(face())
    once = with_neural_rig(parts, at_own_rest(parts, neural_rig(parts, bones=False)), "face")
    again = AttachNeuralRig()(once, at_own_rest(once, neural_rig(once, bones=False, seed=5, shapes=2)), "face").parts
    own = {shape.name for mesh in parts.meshes for shape in mesh.blendshapes}
    names = {shape.name for mesh in again.meshes for shape in mesh.blendshapes}
    assert own | {"neural_000", "neural_001"} <= names
    assert "neural_002" not in names
    taken = with_head(parts, blendshapes=renamed(parts.meshes[0].blendshapes))
    with pytest.raises(InputError, match=r"face -> neural_001: a shape called as one of the neural rig's"):
        with_neural_rig(taken, neural_rig(taken, bones=True), "face")


def renamed(shapes: tuple[Blendshape, ...]) -> tuple[Blendshape, ...]:
    return (replace(shapes[0], name="neural_001"), *shapes[1:])


def test_faces_of_other_meshes_joints_or_skin_are_refused() -> None:
    parts = face()
    rig = neural_rig(parts, bones=True)
    with pytest.raises(TopologyError, match=r"head\.usda: other meshes than the neural rig was learned on, expected"):
        with_neural_rig(replace(parts, meshes=parts.meshes[:1]), rig, "head.usda")
    with pytest.raises(TopologyError, match="0 joints that differ, expected the 3 that the neural rig moves"):
        with_neural_rig(face(joints=False), rig, "head.usda")
    skeleton = replace(parts.skeleton, rest_transforms=parts.skeleton.rest_transforms @ np.diag([1.1, 1, 1, 1]))
    with pytest.raises(TopologyError, match="rest transforms of the skeleton differ"):
        with_neural_rig(replace(parts, skeleton=skeleton), rig, "head.usda")
    head = parts.meshes[0]
    assert head.skin is not None
    other = replace(head, skin=replace(head.skin, joint_weights=np.roll(head.skin.joint_weights, 1, axis=1)))
    with pytest.raises(TopologyError, match="skin weights differ"):
        with_neural_rig(replace(parts, meshes=(other, *parts.meshes[1:])), rig, "head.usda")
