"""The differentiable rasteriser against brute force and against the rasteriser of pictures."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from small_head import make
from with_torch import tensor, torch

from facepipe.geometry import rasterise as geometry
from facepipe.parts import FaceParts
from facepipe.photo.renderer.camera import Camera
from facepipe.photo.renderer.rasterise import Raster, barycentrics, facing, interpolate, rasterise
from facepipe.pictures.camera import portrait
from facepipe.pictures.scene import build_scene

pytestmark = pytest.mark.needs_torch

HEIGHT, WIDTH = 20, 26


def soup(seed: int, count: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of all sizes at all depths: on the image, across its border, off it, behind the camera, flat."""
    rng = np.random.default_rng(seed)
    middle = rng.uniform((-10, -10), (WIDTH + 10, HEIGHT + 10), (count, 1, 2))
    xy = middle + rng.normal(size=(count, 3, 2)) * rng.choice([0.3, 3, 20], (count, 1, 1))
    depth = rng.uniform(1, 9, (count, 3, 1))
    depth[:3, 1], depth[3:5] = -2.0, -1.0
    points = np.concatenate([xy, depth], axis=2)
    points[5, 2] = points[5, 1]
    points[6] = points[6, 0] + np.linspace(0, 1, 3)[:, None] * (7.0, 3.0, 1.0)
    return points.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3)


def brute_force(points: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nearest triangle (HEIGHT, WIDTH) or -1, and its perspective-correct barycentrics, one pixel after the other."""
    ids, weights = np.full((HEIGHT, WIDTH), -1), np.zeros((HEIGHT, WIDTH, 3))
    for row, column in np.ndindex(HEIGHT, WIDTH):
        nearest = np.inf
        for number, corners in enumerate(points[triangles]):
            if (corners[:, 2] <= 0).any():
                continue
            matrix = np.stack([corners[:, 0], corners[:, 1], np.ones(3)])
            if abs(np.linalg.det(matrix)) < 1e-9:
                continue
            flat = np.linalg.solve(matrix, (column + 0.5, row + 0.5, 1))
            depth = 1 / (flat / corners[:, 2]).sum()
            if flat.min() >= 0 and depth < nearest:
                nearest, ids[row, column] = depth, number
                weights[row, column] = flat / corners[:, 2] * depth
    return ids, weights


def shown(raster: Raster) -> np.ndarray:
    """(height, width) triangle of each pixel, -1 where there is none."""
    ids = torch.full((raster.height * raster.width,), -1)
    ids[raster.pixels] = raster.triangles
    return ids.reshape(raster.size).numpy()


@pytest.mark.parametrize("seed", range(4))
def test_small_scenes_as_by_brute_force(seed: int) -> None:
    points, triangles = soup(seed)
    ids, expected = brute_force(points, triangles)
    raster = rasterise(tensor(points), torch.tensor(triangles), HEIGHT, WIDTH)
    np.testing.assert_array_equal(shown(raster), ids)
    weights = barycentrics(tensor(points), torch.tensor(triangles), raster)
    np.testing.assert_allclose(weights.numpy(), expected[ids >= 0], atol=1e-9)
    covered, corners = expected[ids >= 0], triangles[ids[ids >= 0]]
    values = np.random.default_rng(9).normal(size=(len(points), 4))
    found = interpolate(tensor(values), torch.tensor(triangles), raster, weights)
    np.testing.assert_allclose(found, np.einsum("pk,pkc->pc", covered, values[corners]), atol=1e-8)
    depth = np.einsum("pk,pk->p", covered, points[corners, 2])
    np.testing.assert_allclose(raster.nearness.reshape(raster.size).numpy()[ids >= 0], 1 / depth, rtol=1e-6)
    assert (raster.nearness.reshape(raster.size).numpy()[ids < 0] == 0).all()


@cache
def sample() -> FaceParts:
    return make(0)


@pytest.mark.parametrize("kind", ["float32", "float64"])
@pytest.mark.parametrize("view", ["front", "side", (0.5, 0.4)])
def test_a_head_as_in_pictures(view: str | tuple[float, float], kind: str) -> None:
    scene = build_scene(sample(), None)
    own = portrait(scene.points, view, 300, 200)
    expected = geometry.rasterise(geometry.screen_triangles(own.project(scene.points), scene.triangles), 300, 200)
    dtype = getattr(torch, kind)
    points = Camera.at(own.axes, own.eye, own.focal, own.center, dtype=dtype).project(tensor(scene.points).to(dtype))
    ids = shown(rasterise(points, torch.tensor(scene.triangles), 200, 300))
    assert (expected.triangle >= 0).mean() > 0.15
    assert (ids == expected.triangle).mean() >= 0.999
    np.testing.assert_array_equal(ids >= 0, expected.triangle >= 0)


@pytest.mark.parametrize("offset", [0.0, 0.5])
def test_shared_edges_through_pixel_centres_leave_no_gaps_and_no_double_hits(offset: float) -> None:
    """A square of 8 x 8 quads, corners on pixel corners or on centres, covers 64 pixels, 32 by each half."""
    x, y = np.meshgrid(np.arange(9), np.arange(9))
    points = np.stack([x + 3 + offset, y + 2 + offset, np.full(x.shape, 5.0)], axis=-1).reshape(-1, 3)
    corner = (np.arange(8)[:, None] * 9 + np.arange(8)).ravel()
    halves = [[corner, corner + 1, corner + 10], [corner, corner + 10, corner + 9]]
    triangles = torch.tensor(np.concatenate([np.stack(half, axis=1) for half in halves]))
    alone = [rasterise(tensor(points), half, HEIGHT, WIDTH).pixels for half in (triangles[:64], triangles[64:])]
    both = rasterise(tensor(points), triangles, HEIGHT, WIDTH).pixels
    assert len(both) == 64
    assert sorted(torch.cat(alone).tolist()) == both.tolist()


def test_gradients_of_attributes_and_points_are_exact() -> None:
    points, triangles = soup(1)
    raster = rasterise(tensor(points), torch.tensor(triangles), HEIGHT, WIDTH)
    seen = torch.tensor(np.unique(triangles[raster.triangles.numpy()]))
    moved, fixed = tensor(points)[seen].requires_grad_(), tensor(points)
    values = tensor(np.random.default_rng(3).normal(size=(len(points), 2)), requires_grad=True)

    def painted(own: torch.Tensor, attributes: torch.Tensor) -> torch.Tensor:
        placed = fixed.index_copy(0, seen, own)
        weights = barycentrics(placed, torch.tensor(triangles), raster)
        shown_values = interpolate(attributes, torch.tensor(triangles), raster, weights)
        return raster.paint(shown_values, attributes[0])[::3, ::3]

    assert torch.autograd.gradcheck(painted, (moved, values), atol=1e-4)


def test_fronts_are_counter_clockwise_to_the_viewer() -> None:
    points = tensor([[2, 10, 1], [12, 10, 1], [2, 2, 1]])  # y points down: counter-clockwise as seen
    for order, expected in (([0, 1, 2], 1), ([0, 2, 1], -1)):
        triangles = torch.tensor([order])
        raster = rasterise(points, triangles, HEIGHT, WIDTH)
        assert (facing(points, triangles, raster) == expected).all()
        assert len(raster.pixels) > 20


NOTHING = {
    "no triangles": ([[1, 1, 1]], np.zeros((0, 3), np.int64)),
    "behind": ([[2, 2, -1], [9, 2, -1], [2, 9, -1]], [[0, 1, 2]]),
    "at the eye": ([[2, 2, 0], [9, 2, 0], [2, 9, 0]], [[0, 1, 2]]),
    "beside": ([[200, 2, 1], [290, 2, 1], [200, 9, 1]], [[0, 1, 2]]),
    "above": ([[2, -200, 1], [9, -200, 1], [2, -290, 1]], [[0, 1, 2]]),
    "a line": ([[2, 2, 1], [4, 4, 1], [9, 9, 1]], [[0, 1, 2]]),
    "a point": ([[2, 2, 1]], [[0, 0, 0]]),
    "not finite": ([[np.nan, 2, 1], [9, 2, 1], [2, np.inf, 1]], [[0, 1, 2]]),
    "out of reach": ([[2, 2, 1], [1e30, 2, 1], [2, 9, 1]], [[0, 1, 2]]),
}


@pytest.mark.parametrize("name", NOTHING)
@pytest.mark.parametrize("kind", ["float32", "float64"])
def test_what_can_not_be_seen_leaves_the_background(name: str, kind: str) -> None:
    points = tensor(NOTHING[name][0]).to(getattr(torch, kind)).requires_grad_()
    triangles = torch.tensor(NOTHING[name][1])
    raster = rasterise(points, triangles, HEIGHT, WIDTH)
    weights = barycentrics(points, triangles, raster)
    image = raster.paint(interpolate(points, triangles, raster, weights), points.new_tensor([1, 2, 3]))
    image.sum().backward()
    assert len(raster.pixels) == 0
    assert (image == points.new_tensor([1, 2, 3])).all()
    assert points.grad is None or (points.grad == 0).all()


def test_an_image_without_pixels() -> None:
    points, triangles = soup(0)
    for size in ((0, 5), (5, 0)):
        raster = rasterise(tensor(points), torch.tensor(triangles), *size)
        assert raster.paint(torch.zeros(0, 2), torch.zeros(2)).shape == (*size, 2)
