"""What self-shadowing takes from light: nothing of a ball, all inside of one, and what integrals say beside a wall."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from solids import ball
from with_torch import torch

from facepipe.photo.descent.shadows import sky_visibility, transfer_of, visibility
from facepipe.photo.renderer.light import ambient, basis, distant, shade

pytestmark = pytest.mark.needs_torch

UP = torch.tensor([[0.0, 0.0, 1.0]])


def flat(values: object) -> torch.Tensor:
    return torch.tensor(np.asarray(values), dtype=torch.float32)


def square(corner: object, one: object, other: object, count: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """Points and triangles of a parallelogram, cut into a grid."""
    steps = np.linspace(0, 1, count)
    a, b = np.meshgrid(steps, steps, indexing="ij")
    points = np.asarray(corner) + a[..., None] * np.asarray(one) + b[..., None] * np.asarray(other)
    first = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
    corners = np.stack([first, first + count, first + count + 1, first + 1], axis=1)
    return points.reshape(-1, 3), np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])


def room() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """A floor z = 0 with normals up, and a wall x = 0 as high as it is wide that stands on it."""
    floor, floor_triangles = square((0, -1, 0), (1, 0, 0), (0, 2, 0), 20)
    wall, wall_triangles = square((0, -1, 0), (0, 2, 0), (0, 0, 1))
    points = np.concatenate([floor, wall])
    normals = np.concatenate([np.tile((0.0, 0.0, 1.0), (len(floor), 1)), np.tile((1.0, 0.0, 0.0), (len(wall), 1))])
    return flat(points), flat(normals), torch.tensor(np.concatenate([floor_triangles, wall_triangles + len(floor)]))


def shadow_transfer(
    points: torch.Tensor, normals: torch.Tensor, triangles: torch.Tensor, directions: int | None = None
) -> torch.Tensor:
    """(n, 9) of points (n, 3) with normals among triangles."""
    return transfer_of(sky_visibility(points, triangles, directions), normals)


def floor_integral(x: float, y: float) -> np.ndarray:
    """(9,) of the point (x, y, 0) of that floor: what the wall takes of each harmonic's light, over pi, by cubature."""
    heights, turns = (np.arange(300) + 0.5) / 300, 2 * np.pi * (np.arange(600) + 0.5) / 600
    z, turn = np.meshgrid(heights, turns, indexing="ij")  # equal areas on the sphere
    flat_part = np.sqrt(1 - z**2)
    direction = np.stack([flat_part * np.cos(turn), flat_part * np.sin(turn), z], axis=-1)
    with np.errstate(divide="ignore"):
        reach = np.where(direction[..., 0] < 0, -x / direction[..., 0], np.inf)
    hit = np.isfinite(reach)
    reach = np.where(hit, reach, 0)
    hit &= (np.abs(y + reach * direction[..., 1]) <= 1) & (reach * z <= 1)
    harmonics = basis(torch.tensor(direction)).numpy()
    cell = 2 * math.pi / hit.size
    return np.asarray((harmonics * (z * hit)[..., None]).sum(axis=(0, 1)) * cell / math.pi)


def test_a_ball_keeps_all_its_light() -> None:
    points, triangles = ball()
    normals, white = flat(points), torch.ones(3)
    lost = shadow_transfer(normals, normals, torch.tensor(triangles))
    lamp = distant(flat((0.6, 0.0, 0.8)), white) + 0.3 * ambient(white)
    off = (shade(normals, lamp, lost) - shade(normals, lamp)).abs()
    assert off.max() < 0.03
    assert off.mean() < 0.01


def test_no_light_comes_into_a_closed_ball() -> None:
    """Whatever light: a surface inside is black, with any normal."""
    rng = np.random.default_rng(0)
    shell, triangles = ball()
    inside, normals = rng.uniform(-0.4, 0.4, (30, 3)), rng.normal(size=(30, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    lost = shadow_transfer(
        flat(np.concatenate([shell, inside])), flat(np.concatenate([shell, normals])), torch.tensor(triangles)
    )[len(shell) :]
    np.testing.assert_allclose(lost, -basis(flat(normals)), atol=0.02)
    lamp = distant(flat((0.6, 0.0, 0.8)), flat((1.0, 1.0, 1.0))) + ambient(flat((0.3, 0.3, 0.3)))
    assert shade(flat(normals), lamp).max() > 1
    assert shade(flat(normals), lamp, lost).max() < 0.03


def test_a_wall_takes_from_the_floor_what_integrals_say() -> None:
    """Of each harmonic of the light that comes, whose coefficients hold the cosine's share too."""
    points, normals, triangles = room()
    kernel = np.repeat([1, 2 / 3, 1 / 4], [1, 3, 5])
    chosen = [45, 105, 170, 229]
    expected = np.stack([floor_integral(*points[number, :2].tolist()) for number in chosen])
    for directions, bound in ((96, 0.025), (400, 0.012)):
        lost = shadow_transfer(points, normals, triangles, directions)[chosen].numpy() * kernel
        np.testing.assert_allclose(lost, -expected, atol=bound)


def test_creases_lose_most() -> None:
    """Ambient light on the floor grows with the distance from the wall, from half of it on."""
    points, normals, triangles = room()
    lit = shade(normals, ambient(torch.ones(3)), shadow_transfer(points, normals, triangles))[: 20 * 20, 0]
    middle = lit.reshape(20, 20)[:, 10].numpy()
    assert middle[1] < 0.68
    assert middle[-1] > 0.85
    assert (np.diff(middle[1:]) > -0.02).all()
    assert lit.max() < 1.01


def test_what_turns_with_its_light_looks_the_same() -> None:
    points, normals, triangles = room()
    lamp = flat((0.48, 0.6, 0.64))
    turn = flat(Rotation.from_rotvec((0.4, -0.9, 0.7)).as_matrix())
    white = torch.ones(3)
    here, there = (
        shade(
            normals @ by.mT,
            distant(by @ lamp, white) + 0.4 * ambient(white),
            shadow_transfer(points @ by.mT, normals @ by.mT, triangles),
        )[: 20 * 20]
        for by in (torch.eye(3), turn)
    )
    assert (here - there).abs().mean() < 0.02
    assert (shade(normals, distant(lamp, white) + 0.4 * ambient(white))[: 20 * 20] - here).abs().mean() > 0.05


def test_place_and_size_do_not_matter() -> None:
    points, normals, triangles = room()
    own = shadow_transfer(points, normals, triangles)
    for scale, shift in itertools.product((0.01, 100.0), ((0.0, 0.0, 0.0), (3.0, -2.0, 5.0))):
        other = shadow_transfer(scale * (points + flat(shift)), normals, triangles, 96)
        assert (other - own).abs().mean() < 2e-3


def test_without_triangles_nothing_is_shaded() -> None:
    points, normals, _ = room()
    assert (shadow_transfer(points, normals, torch.zeros((0, 3), dtype=torch.int64)) == 0).all()


def test_a_lamp_casts_the_shadow_of_the_wall() -> None:
    """From 45 degrees behind a wall of height 1, the floor is dark up to 1 from it, and light beyond its ends."""
    points, _, triangles = room()
    arriving = visibility(points, triangles, flat((-math.sqrt(0.5), 0.0, math.sqrt(0.5))))[: 20 * 20].reshape(20, 20)
    assert (arriving[1:-1, 1:-1] < 0.05).all()
    slanted = torch.nn.functional.normalize(flat((-0.5, 0.0, 1.0)), dim=0)  # the shadow is half as long
    arriving = visibility(points, triangles, slanted)[: 20 * 20].reshape(20, 20)[:, 3:-3]
    along = np.linspace(0, 1, 20)
    assert (arriving[(along > 0.06) & (along < 0.45)] < 0.05).all()
    assert (arriving[along > 0.55] > 0.95).all()


def test_sharp_views_have_sharp_shadows() -> None:
    points, _, triangles = room()
    slanted = torch.nn.functional.normalize(flat((-0.5, 0.0, 1.0)), dim=0)
    floor = square((0, -0.5, 0), (1, 0, 0), (0, 1, 0), 200)[0]
    finer = torch.cat([points, flat(floor)])
    widths = []
    for resolution in (64, 512):
        arriving = visibility(finer, triangles, slanted, resolution)[len(points) :].reshape(200, 200).mean(dim=1)
        widths.append(int(((arriving > 0.02) & (arriving < 0.98)).sum()))
    assert widths[1] < 0.3 * widths[0]
