"""Wrinkles in pictures: colours and normals by the rule, of shape weights."""

from __future__ import annotations

import numpy as np
import pytest
from wrinkled import known, wrinkled_square

from facepipe.pictures import PictureOptions, picture
from facepipe.pictures.camera import portrait
from facepipe.pictures.scene import build_scene
from facepipe.pictures.shade import Materials

WEIGHTS = [
    {},
    {"smile": 1.0},
    {"smile": 0.4, "squint": 0.5},
    {"frown": 1.0, "smile": 0.3},
    {"smile": 3.0, "frown": 2.0},
]


@pytest.mark.parametrize("weights", WEIGHTS, ids=str)
def test_the_shader_keeps_to_the_rule(weights: dict[str, float]) -> None:
    """Base colours and normals at random places, those of the rule in closed form, to what 8 bits and texels hold."""
    scene = build_scene(wrinkled_square(), None, 512)
    camera = portrait(scene.points, "front", 512, 512, 0)
    rng = np.random.default_rng(1)
    shares = rng.dirichlet(np.ones(3), 400).astype(np.float32)
    ids = rng.integers(0, len(scene.triangles), 400)
    uv = np.einsum("mk,mkc->mc", shares, scene.uv_corners("st")[ids])
    inside = (np.abs(uv - 0.5) < 0.49).all(axis=1)  # textures repeat beyond their last texels
    normals = np.tile(np.array([0, 0, 1], np.float32), (400, 1))
    found = Materials(scene, camera, weights).at(ids, shares, normals, np.ones((400, 3), np.float32))
    base, turned = known(uv, weights)
    np.testing.assert_allclose(found.base[inside], base[inside], atol=0.004)
    np.testing.assert_allclose(found.normals[inside], turned[inside], atol=0.012)


def test_pictures_show_weights() -> None:
    """The half whose shape moves is wrinkled, the quarter beyond is as it was."""
    parts = wrinkled_square()

    def drawn(weights: dict[str, float]) -> np.ndarray:
        return np.asarray(
            picture(parts, None, PictureOptions(size=64, weights=weights, background=(0.0, 0.0, 0.0))), float
        )

    plain, smiling = drawn({}), drawn({"smile": 1.0})
    change = np.abs(smiling - plain).max(axis=(0, 2))  # of each column of pixels
    columns = np.flatnonzero(plain.max(axis=(0, 2)) > 20)
    first, last = columns[0], columns[-1]
    at = np.linspace(first, last, 5).round().astype(int)  # quarters of the square
    assert (change[first + 1 : at[2]] > 8).all()
    assert (change[at[3] + 4 : last] <= 2).all()  # light scatters a little way below the skin
