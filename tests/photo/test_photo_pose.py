"""Poses of heads in photos, bounded Levenberg-Marquardt, and the part of a photo that a fit looks at."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares, rosen
from scipy.spatial.transform import Rotation
from with_torch import tensor, torch

from facepipe.photo.descent.landmark_fit import Minimum, Quadratic, levenberg_marquardt
from facepipe.photo.descent.subject import FOCAL, PoseSpace
from facepipe.photo.descent.working_photo import WorkingPhoto, to_linear, to_srgb
from facepipe.photo.renderer.camera import Camera

pytestmark = pytest.mark.needs_torch

MIDDLE = np.array([0.3, 14.0, -2.0])
SPACE = PoseSpace(middle=MIDDLE, size=24.0, center=(320.0, 240.0), side=640.0)
ANGLES = st.floats(-2.0, 2.0)


def head(count: int = 40, seed: int = 0) -> np.ndarray:
    """Points (count, 3) about the middle, as large as a face."""
    return MIDDLE + np.random.default_rng(seed).normal(size=(count, 3)) * (5.0, 6.0, 3.0)


# Poses


@given(
    turn=st.tuples(ANGLES, ANGLES, ANGLES),
    at=st.tuples(st.floats(0, 1), st.floats(0, 1)),
    scale=st.floats(-2, 1),
    distance=st.floats(0, 4),
)
@settings(max_examples=40, deadline=None)
def test_the_numbers_of_a_pose_are_what_a_photo_shows(
    turn: tuple[float, ...], at: tuple[float, ...], scale: float, distance: float
) -> None:
    """Where the head's middle is, how large a head there, how far away: read off the camera again."""
    pose = np.array([*turn, *at, scale, distance])
    camera = SPACE.camera(tensor(pose))
    x, y, depth = camera.project(tensor(MIDDLE[None]))[0].tolist()
    assert (x / 640, y / 640) == pytest.approx(at, abs=1e-9)
    assert depth / 24 == pytest.approx(np.exp(distance), rel=1e-9)
    assert float(camera.focal) * 24 / depth / 640 == pytest.approx(np.exp(scale), rel=1e-9)
    assert SPACE.log_focal(pose) == pytest.approx(np.log(float(camera.focal) / 640), abs=1e-9)
    assert camera.center.tolist() == [320, 240]
    np.testing.assert_allclose(camera.rotation, turn)


def test_distance_alone_hardly_moves_a_flat_head_in_its_photo() -> None:
    """A dolly zoom: what is as near as the middle stays, what is nearer grows."""
    points = MIDDLE + np.array([(3.0, 2.0, 0.0), (3.0, 2.0, 4.0)])
    poses = tensor([[0, 0, 0, 0.5, 0.375, -0.3, far] for far in (1.0, 2.0)])
    near, far = SPACE.camera(poses).project(tensor(points))[..., :2].numpy() - SPACE.center
    np.testing.assert_allclose(near[0], far[0], atol=1e-9)
    assert (np.abs(near[1]) > 1.03 * np.abs(far[1])).all()
    assert (np.abs(far[1]) > 1.01 * np.abs(far[0])).all()


def test_batches_of_poses_have_gradients() -> None:
    poses = tensor(np.random.default_rng(0).normal(size=(2, 7)) * 0.3 + (0, 0, 0, 0.5, 0.5, 0, 1.5)).requires_grad_()
    assert torch.autograd.gradcheck(lambda own: SPACE.camera(own).project(tensor(head(5)))[..., :2], (poses,))


@pytest.mark.parametrize("turn", [(0, 0, 0), (0.3, -0.5, 0.2), (0, 0, 2.8), (-0.2, 1.3, 0.1), (0.1, 3.0, 0.0)])
def test_a_first_guess_is_the_pose_of_a_camera_far_away(turn: tuple[float, float, float]) -> None:
    pose = np.array([*turn, 0.45, 0.35, -0.8, np.log(400.0)])
    pixels = SPACE.camera(tensor(pose)).project(tensor(head()))[:, :2].numpy()
    found = SPACE.guess(head(), pixels)
    apart = (Rotation.from_rotvec(found[:3]) * Rotation.from_rotvec(turn).inv()).magnitude()
    assert apart < 0.01
    np.testing.assert_allclose(found[3:6], pose[3:6], atol=3e-3)
    assert found[5] + found[6] == pytest.approx(np.log(FOCAL)), "a portrait lens until more is known"


def test_a_first_guess_of_a_portrait_is_near() -> None:
    pose = np.array([0.1, 0.4, -0.1, 0.55, 0.45, -0.5, np.log(FOCAL) + 0.5])
    pixels = SPACE.camera(tensor(pose)).project(tensor(head()))[:, :2].numpy()
    pixels += np.random.default_rng(1).normal(size=pixels.shape)
    found = SPACE.guess(head(), pixels)
    apart = (Rotation.from_rotvec(found[:3]) * Rotation.from_rotvec(pose[:3]).inv()).magnitude()
    assert apart < 0.15
    np.testing.assert_allclose(found[3:6], pose[3:6], atol=0.1)


@pytest.mark.parametrize("pixels", [np.full((40, 2), 7.0), np.stack([np.arange(40.0)] * 2, axis=1)])
def test_a_first_guess_of_nonsense_is_finite(pixels: np.ndarray) -> None:
    found = SPACE.guess(head(), pixels)
    assert np.isfinite(found).all()


# Bounded Levenberg-Marquardt


def solve(
    residuals: Callable[[np.ndarray], np.ndarray], start: object, lower: object, upper: object, steps: int = 300
) -> tuple[Minimum, np.ndarray]:
    """The minimum of half the sum of squares, and its gradient."""

    def jacobian(x: np.ndarray) -> np.ndarray:
        return np.stack([(residuals(x + h) - residuals(x - h)) / 2e-6 for h in 1e-6 * np.eye(len(x))], axis=1)

    def model(x: np.ndarray) -> Quadratic:
        r, J = residuals(x), jacobian(x)
        return Quadratic(cost=float(r @ r) / 2, gradient=J.T @ r, hessian=J.T @ J)

    own = (np.asarray(each, dtype=float) for each in (start, lower, upper))
    minimum = levenberg_marquardt(model, lambda x: model(x).cost, *own, steps=steps, tolerance=1e-13)
    return minimum, model(minimum.x).gradient


def rosenbrock(x: np.ndarray) -> np.ndarray:
    return np.concatenate([10 * (x[1:] - x[:-1] ** 2), 1 - x[:-1]])


def decay(x: np.ndarray) -> np.ndarray:
    """A sum of two exponentials, observed with some noise."""
    t = np.linspace(0, 4, 40)
    seen = 2.0 * np.exp(-0.7 * t) + 0.8 * np.exp(-2.5 * t) + 0.02 * np.random.default_rng(0).normal(size=40)
    return np.asarray(x[0] * np.exp(-x[1] * t) + x[2] * np.exp(-x[3] * t) - seen)


CASES = {
    "free": (rosenbrock, [-1.2, 1.0, 0.5], [-5] * 3, [5] * 3),
    "bounded": (rosenbrock, [-1.2, -1.0, 0.2], [-5] * 3, [0.6, 5, 5]),
    "corner": (rosenbrock, [-1.0, 0.0, 0.0], [-2, -1, -1], [0.5, 0.2, 0.01]),
    "one side": (rosenbrock, [-1.2, 1.0], [-np.inf] * 2, [0.7, np.inf]),
    "from a bound": (decay, [1.0, 0.0, 0.0, 3.0], [0, 0, 0, 0], [10, 1, 0.6, 5]),
}


@pytest.mark.parametrize("name", CASES)
def test_minima_are_those_of_scipy_and_settled_within_bounds(name: str) -> None:
    residuals, start, lower, upper = CASES[name]
    found, gradient = solve(residuals, start, lower, upper)
    inside = np.clip(start, np.array(lower) + 1e-9, np.array(upper) - 1e-9)
    peer = least_squares(residuals, inside, bounds=(lower, upper), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    assert found.settled
    assert found.cost <= peer.cost * (1 + 1e-6) + 1e-12
    np.testing.assert_allclose(found.x, peer.x, atol=2e-4)
    assert ((np.array(lower) <= found.x) & (found.x <= upper)).all()
    at_lower, at_upper = found.x == lower, found.x == upper
    scale = 1e-4 * max(1.0, float(np.abs(gradient).max()))
    assert (np.abs(gradient[~at_lower & ~at_upper]) <= scale).all()
    assert (gradient[at_lower] >= -scale).all()
    assert (gradient[at_upper] <= scale).all()
    if name in ("bounded", "corner", "one side", "from a bound"):
        assert (at_lower | at_upper).any()


def test_held_variables_stay_and_starts_outside_come_in() -> None:
    found, _ = solve(rosenbrock, [3.0, 0.25, 9.0], [-2, 0.25, -2], [2, 0.25, 2])
    assert found.x[1] == 0.25
    assert found.x[0] == pytest.approx(least_squares(
        lambda x: rosenbrock(np.array([x[0], 0.25, 0.0625])), [0.4]
    ).x[0], abs=1e-4)  # fmt: skip


def test_cost_falls_with_every_step_allowed() -> None:
    costs = [solve(rosenbrock, [-1.2, 1.0], [-5, -5], [5, 5], steps)[0].cost for steps in (0, 1, 2, 4, 8, 16, 60)]
    assert costs[0] == pytest.approx(rosen([-1.2, 1.0]) / 2)
    assert costs == sorted(costs, reverse=True)
    assert costs[-1] < 1e-12
    assert not solve(rosenbrock, [-1.2, 1.0], [-5, -5], [5, 5], 2)[0].settled


def test_what_nothing_depends_on_stays() -> None:
    found, _ = solve(lambda x: np.array([x[0] - 0.3, 2 * (x[0] - 0.3)]), [0.9, 0.77], [0, 0], [1, 1])
    assert found.x == pytest.approx([0.3, 0.77], abs=1e-6)


# Windows of photos


def gradient_photo(height: int, width: int) -> np.ndarray:
    """Red grows with x, green with y, by the pixel centre's place."""
    y, x = np.mgrid[:height, :width] + 0.5
    return np.stack([x / width, y / height, np.full_like(x, 0.5)], axis=-1)


def marks(x: tuple[float, float], y: tuple[float, float]) -> np.ndarray:
    """68 landmarks that fill a box."""
    rng = np.random.default_rng(0)
    inside = rng.uniform((x[0], y[0]), (x[1], y[1]), (66, 2))
    return np.concatenate([inside, [(x[0], y[0]), (x[1], y[1])]])


BOXES = {
    "middle": (400, 500, (200.0, 300.0), (150.0, 260.0)),
    "left border": (400, 500, (2.0, 120.0), (100.0, 230.0)),
    "corner": (401, 503, (420.0, 499.0), (330.0, 399.0)),
    "whole photo": (90, 80, (5.0, 75.0), (5.0, 85.0)),
    "huge": (3001, 2003, (300.0, 1700.0), (600.0, 2400.0)),
    "partly outside": (300, 300, (-60.0, 80.0), (-40.0, 120.0)),
    "tiny": (9, 7, (2.0, 5.0), (2.0, 7.0)),
    "smaller than a step": (3, 200, (-2000.0, 2000.0), (-2000.0, 2000.0)),
}


@pytest.mark.parametrize("name", BOXES)
def test_working_pixels_lie_where_their_camera_and_landmarks_say(name: str) -> None:
    """The photo's colours show where each working pixel was taken from."""
    height, width, x, y = BOXES[name]
    own = WorkingPhoto.from_photo(gradient_photo(height, width), marks(x, y), 64)
    rows, columns = own.size
    assert own.step >= 1
    assert min(rows, columns) >= 1
    assert own.left >= 0
    assert own.left + columns * own.step <= width
    assert own.top >= 0
    assert own.top + rows * own.step <= height
    v, u = np.mgrid[:rows, :columns] + 0.5
    from_colors = own.pixels.numpy()[..., :2] * (width, height)
    np.testing.assert_allclose(own.landmarks(from_colors), np.stack([u, v], axis=-1), atol=2e-3)
    camera = Camera.at(np.eye(3), np.array([0.1, 0.2, 9.0]), 300.0, (width / 2, height / 2), dtype=torch.float64)
    points = tensor(np.random.default_rng(1).normal(size=(10, 3)))
    whole = camera.project(points)[:, :2].numpy()
    np.testing.assert_allclose(own.camera(camera).project(points)[:, :2], own.landmarks(whole), atol=1e-9)


@pytest.mark.parametrize(("name", "least"), [("middle", 0), ("huge", 0), ("left border", 0)])
def test_windows_hold_the_head_at_about_the_size_asked_for(name: str, least: int) -> None:
    height, width, x, y = BOXES[name]
    landmarks = marks(x, y)
    own = WorkingPhoto.from_photo(gradient_photo(height, width), landmarks, 64)
    inside = own.landmarks(landmarks)
    assert (inside >= least).all()
    assert (inside <= own.size[::-1]).all()
    assert max(own.size) <= 1.6 * 64
    assert max(own.size) >= 0.6 * 64
    assert own.landmarks(landmarks)[:, 1].min() > 0.05 * own.size[0], "room for the brow"


def test_photos_are_never_enlarged() -> None:
    photo = np.random.default_rng(0).random((30, 40, 3))
    own = WorkingPhoto.from_photo(photo, marks((10.0, 30.0), (5.0, 25.0)), 512)
    assert own.step == 1
    rows, columns = own.size
    expected = photo[own.top : own.top + rows, own.left : own.left + columns]
    np.testing.assert_allclose(own.pixels, expected.astype(np.float32))


def test_colors_pass_through_linear_light_and_back() -> None:
    """IEC 61966-2-1: both halves, their seam, and slopes that are finite at black."""
    color = torch.linspace(0, 1, 1001, dtype=torch.float64, requires_grad=True)
    light = to_linear(color)
    np.testing.assert_allclose(to_srgb(light).detach(), color.detach(), atol=1e-4)
    assert (light.diff() > 0).all()
    assert light[-1].item() == pytest.approx(1)
    assert float(to_linear(tensor(0.5))) == pytest.approx(0.21404, abs=1e-5)
    to_srgb(light).sum().backward()
    assert color.grad.isfinite().all()
    assert to_srgb(tensor([-0.5, 2.0])).tolist() == pytest.approx([0, 1])
