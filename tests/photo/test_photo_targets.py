"""Portraits of known people, and the measures of a fit to them: properties that the truth must have."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from recovery_landmarks import CONTOUR, FaceLandmarks, pixels
from recovery_looks import DIAGONAL_MM, Pose, camera_of, pose_axes
from recovery_measures import (
    MOVES_MM,
    active_sliders,
    aligned_error,
    face_points,
    mean_distance,
    recovery,
    render_camera,
    slider_errors,
    slider_reach,
    weight_error,
)
from recovery_state import true_state
from recovery_targets import ACTIVE, PLACES, RecoveryTarget, head_without_neck, posed, random_expression, targets
from scipy.spatial.transform import Rotation

from facepipe.heads import make
from facepipe.parts import FaceParts, Slider
from facepipe.rig import Rig, build

pytestmark = pytest.mark.needs_torch

COUNT, SIZE = 2, 64


@pytest.fixture(scope="module")
def face() -> tuple[FaceParts, Rig]:
    parts = make(0)
    return parts, build(parts)


@pytest.fixture(scope="module")
def smiling() -> list[RecoveryTarget]:
    return list(targets(COUNT, 5, size=SIZE))


@pytest.fixture(scope="module")
def calm() -> list[RecoveryTarget]:
    return list(targets(COUNT, 5, size=SIZE, expressions=False))


# Targets


def test_the_same_seed_gives_the_same_portraits_whatever_the_count(smiling: list[RecoveryTarget]) -> None:
    (again,) = targets(1, 5, size=SIZE)
    assert (again.image == smiling[0].image).all()
    assert (again.landmarks == smiling[0].landmarks).all()
    assert (smiling[1].image != again.image).any()
    assert smiling[1].sliders != again.sliders


def test_without_expressions_people_and_cameras_are_the_same(
    smiling: list[RecoveryTarget], calm: list[RecoveryTarget]
) -> None:
    for one, other in zip(smiling, calm, strict=True):
        assert one.sliders == other.sliders
        assert (one.camera.axes == other.camera.axes).all()
        assert (one.camera.eye == other.camera.eye).all()
        assert (one.neutral == other.neutral).all()
        assert other.expressions == {}
        assert (other.points == other.neutral).all()
        assert one.landmarks - one.exact == pytest.approx(other.landmarks - other.exact)
        assert (one.image != other.image).any()
        assert 3 <= len(one.expressions) <= 5


def test_thirty_of_a_persons_sliders_are_drawn_from_their_ranges(
    smiling: list[RecoveryTarget], face: tuple[FaceParts, Rig]
) -> None:
    drawn = []
    for target in smiling:
        moved = [slider for slider in face[0].sliders if target.sliders[slider.name] != slider.default]
        assert len(moved) == ACTIVE
        assert not {"expression", "visemes"} & {one.group for one in moved}
        drawn += [(target.sliders[one.name] - one.minimum) / (one.maximum - one.minimum) for one in moved]
    assert np.histogram(drawn, 4, (0, 1))[0].min() > len(drawn) / 8
    assert 0 <= min(drawn) < max(drawn) <= 1


def test_expressions_never_pull_one_place_both_ways(face: tuple[FaceParts, Rig]) -> None:
    for seed in range(200):
        weights = random_expression(np.random.default_rng(seed))
        names = {name.removesuffix("Left").removesuffix("Right") for name in weights}
        names = {name + "*" * (name + "Left" in weights or name + "Right" in weights) for name in names}
        assert set(weights) <= set(face[1].shapes)
        assert 3 <= len(weights) <= 5
        assert 0 < min(weights.values()) <= max(weights.values()) <= 0.8
        for place in PLACES:
            assert len(names & set(place)) <= 1 or {"mouthLeft", "mouthRight"} & set(weights)


def test_the_head_fills_its_share_of_the_picture_and_lies_inside(
    calm: list[RecoveryTarget], face: tuple[FaceParts, Rig]
) -> None:
    head = head_without_neck(face[0])
    for target in calm:
        seen = pixels(target.camera, target.neutral[head])
        assert 0.599 < np.ptp(seen, axis=0).max() / SIZE < 0.851
        assert (seen > 0).all()
        assert (seen < SIZE).all()


def test_a_pose_turns_the_camera_about_the_head() -> None:
    """Seen from the subject's left the nose points to the picture's left; the lens has its view angle."""
    pose = Pose(yaw=0.3, pitch=0.2, roll=0.1, lens_mm=50.0, share=0.7, place=(0.0, 0.0))
    head = np.random.default_rng(0).normal(size=(50, 3))
    camera = camera_of(pose, head, 100)
    axes = pose_axes(pose)
    assert axes @ axes.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1.0)
    assert min(camera.eye[0], camera.eye[1]) > 0
    assert np.hypot(50, 50) / camera.focal == pytest.approx(DIAGONAL_MM / 2 / 50.0)
    seen = pixels(camera, head)
    assert (seen.max(axis=0) + seen.min(axis=0)) / 2 == pytest.approx([50.0, 50.0], abs=1e-3)


def test_noise_is_a_pixel_strong(calm: list[RecoveryTarget]) -> None:
    errors = np.concatenate([one.landmarks - one.exact for one in calm])
    assert errors.std() == pytest.approx(1.0, rel=0.15)
    assert abs(errors.mean()) < 0.2


def test_the_face_is_drawn_where_its_landmarks_are(calm: list[RecoveryTarget]) -> None:
    """Brows, eyes, nose and lips hide the backdrop."""
    for target in calm:
        inside = np.floor(target.exact[CONTOUR:]).astype(int)
        assert inside.min() >= 0
        assert inside.max() < SIZE
        corner = target.image[0, 0].astype(int)
        at = target.image[inside[:, 1], inside[:, 0]].astype(int)
        assert (np.abs(at - corner).sum(axis=1) > 5).mean() > 0.9


# Landmarks


def camera_at(yaw: float, pitch: float = 0.0) -> Pose:
    return Pose(yaw=yaw, pitch=pitch, roll=0.0, lens_mm=105.0, share=0.7, place=(0.0, 0.0))


def test_from_the_front_landmarks_lie_on_their_points(face: tuple[FaceParts, Rig]) -> None:
    parts, rig = face
    points = rig.evaluate()
    camera = camera_of(camera_at(0.0), points, 256)
    landmarks = FaceLandmarks.of(parts)
    labelled = pixels(camera, points[landmarks.points])
    found = landmarks.project(points, camera)
    assert (found[CONTOUR:] == labelled[CONTOUR:]).all()
    assert mean_distance(found, labelled) < 2.0


@pytest.mark.parametrize("yaw", [0.3, 0.45])
def test_the_far_contour_lies_on_the_outline_and_the_near_one_on_its_points(
    face: tuple[FaceParts, Rig], yaw: float
) -> None:
    """Of the skin at the height of a contour landmark, and in front of it, nothing lies farther out."""
    parts, rig = face
    points = rig.evaluate()
    camera = camera_of(camera_at(yaw), points, 256)
    landmarks = FaceLandmarks.of(parts)
    labelled = pixels(camera, points[landmarks.points])
    found = landmarks.project(points, camera)
    head = points[: landmarks.count]
    seen = pixels(camera, head)
    moved = 0
    for number in (1, 2):
        own = points[landmarks.points[number]]
        level = (np.abs(head[:, 1] - own[1]) < 0.4) & (head[:, 2] > own[2]) & (head[:, 0] < 0)
        assert found[number, 0] == pytest.approx(seen[level, 0].min(), abs=1.0)
        moved += labelled[number, 0] - found[number, 0]
    assert moved > 1.0, "these points are hidden, and the outline is farther out"
    assert (found[11:CONTOUR] == labelled[11:CONTOUR]).all(), "the near side faces the camera"


def test_mirrored_views_give_mirrored_landmarks(face: tuple[FaceParts, Rig]) -> None:
    parts, rig = face
    points = rig.evaluate()
    landmarks = FaceLandmarks.of(parts)
    left, right = (landmarks.project(points, camera_of(camera_at(yaw, 0.1), points, 256)) for yaw in (0.4, -0.4))
    flipped = np.stack([256 - right[:CONTOUR][::-1, 0], right[:CONTOUR][::-1, 1]], axis=1)
    assert left[:CONTOUR] == pytest.approx(flipped, abs=0.05)


# Measures


def test_the_rigid_error_is_blind_to_motion_but_not_to_shape() -> None:
    rng = np.random.default_rng(0)
    truth = rng.normal(size=(40, 3))
    turn = Rotation.from_rotvec([0.3, -1.0, 0.5]).as_matrix()
    assert aligned_error(truth @ turn.T + (3.0, -2.0, 1.0), truth) < 1e-12
    assert aligned_error(1.1 * truth, truth) > 0.05
    grown = truth + 0.1 * rng.normal(size=truth.shape)
    assert aligned_error(grown, truth) <= mean_distance(grown, truth)


def test_slider_errors_are_shares_of_the_range() -> None:
    sliders = [Slider(name="a", minimum=-1.0, maximum=3.0), Slider(name="b", default=0.5), Slider(name="c")]
    errors = slider_errors(sliders, {"a": 2.0}, {"a": 0.0, "b": 0.75, "c": 1.0}, ["a", "b"])
    assert errors == pytest.approx({"a": 0.5, "b": -0.25})
    assert active_sliders(sliders, {"a": 0.07, "b": 0.53, "c": 0.0}) == 1


def test_weights_that_are_off_on_both_sides_do_not_count() -> None:
    assert weight_error({"a": 0.5, "b": 0.01}, {"a": 0.3, "c": 0.4}) == pytest.approx(0.3)
    assert weight_error({"b": 0.01}, {}) == 0.0


def test_reach_is_how_far_the_head_moves_over_the_whole_range(face: tuple[FaceParts, Rig]) -> None:
    """A slider from -1.5 to 1.5 moves the point that its shape moves farthest by three times as much."""
    parts, _ = face
    reach = slider_reach(parts, {"noseDepth": 0.3})
    (shape,) = (blendshape for blendshape in parts.meshes[0].blendshapes if blendshape.name == "noseDepth")
    assert reach["noseDepth"] == pytest.approx(3 * np.linalg.norm(shape.offsets, axis=1).max(), rel=1e-3)
    idle = Slider(name="idle", channels=(("root/neck/head/jaw/tongue", "ty", 1.0),))
    assert slider_reach(replace(parts, sliders=(*parts.sliders, idle)), {})["idle"] == 0.0 < MOVES_MM
    assert slider_reach(replace(parts, sliders=(*parts.sliders, Slider(name="alone"))), {}).keys() == reach.keys()
    assert not {"smile", "blink"} & set(reach)


def test_the_face_is_what_a_viewer_sees(face: tuple[FaceParts, Rig]) -> None:
    parts, _ = face
    chosen = face_points(parts)
    mesh = parts.meshes[0]
    landmarks = np.asarray(mesh.landmarks["multipie68"].indices)
    assert chosen[landmarks[CONTOUR:60]].all()
    assert not chosen[len(mesh.points) :].any()
    for name in ("ears", "neck"):
        assert not chosen[: len(mesh.points)][np.asarray(mesh.regions[name]) > 0.5].any()
    left, right = (np.count_nonzero(chosen[: len(mesh.points)] & (side * mesh.points[:, 0] > 0.01)) for side in (1, -1))
    assert left == pytest.approx(right, rel=0.01)


def test_the_truth_itself_has_no_error(face: tuple[FaceParts, Rig], smiling: list[RecoveryTarget]) -> None:
    from facepipe.photo.descent import subject
    from facepipe.photo.renderer.light import DARK

    parts, rig = face
    target = smiling[0]
    camera = subject.FittedCamera(
        rotation=Rotation.from_matrix(target.camera.axes).as_rotvec(),
        translation=-target.camera.axes @ target.camera.eye,
        focal=target.camera.focal,
        center=target.camera.center,
    )
    assert pixels(render_camera(camera), target.points) == pytest.approx(pixels(target.camera, target.points))
    view = subject.FittedView(
        expressions=target.expressions,
        camera=camera,
        light=np.zeros((9, 3)),
        key=np.array(DARK),
        landmarks=target.exact,
        targets=target.landmarks,
        landmark_error=0.0,
    )
    fit = subject.PhotoFit(
        sliders=target.sliders, views=(view,), tint={}, history=(), kept=0, steps=0, stopped="iterations"
    )
    found = recovery(parts, rig, target, fit)
    assert max(found.landmark_px, found.slider, found.geometry_mm, found.posed_mm, found.expression) < 1e-9
    assert found.noisy_px == pytest.approx(mean_distance(target.exact, target.landmarks))
    assert found.active >= ACTIVE - 3
    assert found.default_mm > 0.5
    off = recovery(parts, rig, target, replace(fit, sliders={}))
    assert off.geometry_mm == pytest.approx(off.default_mm)
    assert posed(parts, rig, {}, {}) == pytest.approx(rig.evaluate())


def test_the_truth_as_unknowns_of_a_fit_shows_the_same_points(smiling: list[RecoveryTarget]) -> None:
    import torch

    from facepipe.photo.descent.fit import pose_space
    from facepipe.photo.descent.subject import Subject

    target, subject = smiling[0], Subject.of(make(0))
    space = pose_space(subject, SIZE, SIZE)
    state = true_state(target, subject, space)
    values, weights = subject.slider_values(state.shares), subject.shape_weights(state.expressions[0])
    names = dict(zip((slider.name for slider in subject.parts.sliders), values, strict=True))
    assert {name: names[name] for name in target.sliders} == pytest.approx(target.sliders)
    shown = dict(zip(subject.rig.shapes, weights, strict=True))
    assert {name: weight for name, weight in shown.items() if weight} == pytest.approx(target.expressions)
    seen = space.camera(torch.as_tensor(state.poses[0])).project(torch.as_tensor(target.points))[:, :2]
    assert seen.numpy() == pytest.approx(pixels(target.camera, target.points), abs=1e-6)
