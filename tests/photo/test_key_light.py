"""A lamp beside the harmonics: the shading that `facepipe.pictures` has, its gradient, and images that it lights."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from photo_people import joint_loss, model, portrait
from with_torch import torch

from facepipe.photo.renderer.light import DARK, KeyLight, hue_cost
from facepipe.pictures.lighting import Light, Samples, Studio

pytestmark = pytest.mark.needs_torch

DIRECTION, COLOR, SHINE, ROUGHNESS = (0.4, 0.5, 0.8), (0.9, 0.7, 0.5), 0.7, 0.5
NUMBERS = torch.tensor([*DIRECTION, *COLOR, SHINE, math.log(2 / ROUGHNESS**4 - 2)], dtype=torch.float64)
BLACK = (0.0, 0.0, 0.0)


def surface(count: int = 200) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Random unit normals, unit directions to the eye, mostly on one side, and shares of light that arrive."""
    rng = np.random.default_rng(0)
    vectors = (rng.normal(size=(count, 3)) + np.array([0.0, 0.0, 1.5]) for _ in range(2))
    normals, eye = (torch.tensor(vector / np.linalg.norm(vector, axis=1, keepdims=True)) for vector in vectors)
    return normals, eye, torch.tensor(rng.uniform(size=count))


def lamp(numbers: torch.Tensor = NUMBERS) -> KeyLight:
    return KeyLight(numbers=numbers, arriving=torch.ones(1))


def test_it_shines_as_the_lamps_of_pictures_do() -> None:
    """`facepipe.pictures` has the same model, written without torch."""
    normals, eye, _ = surface()
    all_of_it = torch.ones(len(normals), dtype=torch.float64)
    matt, mirrored = lamp().shade(normals, eye, all_of_it)
    whole = np.ones(len(normals), np.float32)
    samples = Samples(
        normals=normals.numpy().astype(np.float32),
        towards_eye=eye.numpy().astype(np.float32),
        up=np.array([0, 1, 0], np.float32),
        base=np.full((len(normals), 3), 0.3, np.float32),
        roughness=np.full(len(normals), ROUGHNESS, np.float32),
        carried=whole[:, None],
        mirror=np.full((len(normals), 3), 0.04, np.float32),
        coat=0 * whole,
        coat_roughness=whole,
        inside=whole,
    )
    alone = Light(direction=DIRECTION, color=COLOR, highlight=SHINE)
    lit = Studio(lights=(alone,), sky=BLACK, ground=BLACK, shadows=False).light(samples)
    np.testing.assert_allclose(matt, lit.diffuse, atol=2e-5)
    np.testing.assert_allclose(mirrored, lit.highlights, rtol=2e-5, atol=2e-5)
    assert mirrored.max() > 0.05


def test_what_does_not_arrive_neither_lights_nor_shines() -> None:
    normals, eye, arriving = surface()
    whole, part = (lamp().shade(normals, eye, share) for share in (torch.ones_like(arriving), arriving))
    for one, other in zip(whole, part, strict=True):
        torch.testing.assert_close(one * arriving[:, None], other)


def test_its_gradient() -> None:
    normals, eye, arriving = surface(12)
    free = [one.clone().requires_grad_() for one in (NUMBERS, normals, eye)]
    assert torch.autograd.gradcheck(lambda n, a, e: lamp(n).shade(a, e, arriving), free)


def test_negative_light_is_none() -> None:
    normals, eye, arriving = surface()
    for index in (3, 6):
        numbers = NUMBERS.clone()
        numbers[index : index + 3 if index == 3 else index + 1] = -1.0
        matt, mirrored = lamp(numbers).shade(normals, eye, arriving)
        assert (mirrored == 0).all()
        assert (matt == 0).all() == (index == 3)


def test_an_image_shows_it() -> None:
    """Where something stands before it, the image is that without a lamp; elsewhere brighter, in its colour."""
    red = torch.tensor([0.0, 0.3, 1.0, 0.8, 0.0, 0.0, 0.5, 3.0])
    own = portrait(size=128, lamp=tuple(red.tolist()))
    loss = joint_loss(own)
    with torch.no_grad():
        shown = loss.image(own.truth, 0)
        black = loss.image(replace(own.truth, key=torch.tensor([DARK])), 0)
        shadows = loss.shadows[0]
        assert shadows is not None
        loss.shadows[0] = replace(shadows, arriving=torch.zeros_like(shadows.arriving))
        hidden = loss.image(own.truth, 0)
    assert len(shadows.arriving) == len(model().rig())
    torch.testing.assert_close(hidden, black)
    added = (shown - black)[..., :3]
    torch.testing.assert_close(added[..., 1:], torch.zeros_like(added[..., 1:]), atol=1e-6, rtol=0)
    assert added[..., 0].min() > -1e-6
    assert added[..., 0].max() > 0.15
    assert 0.1 < float((added[..., 0] > 0.01).float().mean()) < 0.6


def test_another_hue_than_around_it_costs() -> None:
    """Nothing for hues as near as those of lamps and windows, more the farther, whatever the strength of the light."""
    grey = torch.zeros((9, 3), dtype=torch.float64)
    grey[0] = 0.8

    def cost(red: float, green: float, blue: float, strength: float = 1.0) -> float:
        lamp = torch.tensor([0, 0, 1, strength * red, strength * green, strength * blue, 0.5, 3.0], dtype=torch.float64)
        return hue_cost(grey, lamp).item()

    assert cost(1, 1, 1) == cost(1.15, 1.0, 0.8) == 0
    assert 0 < cost(1.4, 1.0, 0.6) < cost(1.6, 1.0, 0.4)
    assert cost(1.6, 1.0, 0.4) == pytest.approx(cost(1.6, 1.0, 0.4, strength=3.0), rel=0.05)
    assert cost(1.6, 1.0, 0.4, strength=1e-4) < 0.02 * cost(1.6, 1.0, 0.4)
    assert hue_cost(grey, torch.tensor(DARK, dtype=torch.float64)) == 0
