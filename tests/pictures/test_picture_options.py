"""Pictures with a camera, lights and a backdrop of one's own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from faces import grid_mesh

from facepipe.geometry.colors import from_srgb
from facepipe.parts import FaceParts, Material
from facepipe.pictures import PictureOptions, picture
from facepipe.pictures.camera import Camera, portrait
from facepipe.pictures.lighting import PORTRAIT, Light, Studio

GREY = Material(name="Grey", diffuse_color=(0.5, 0.5, 0.5), roughness=1.0)
NO_LIGHT = Studio(lights=(), sky=(0.0, 0.0, 0.0), ground=(0.0, 0.0, 0.0))


def wall() -> FaceParts:
    return FaceParts(meshes=(replace(grid_mesh("Wall"), material="Grey"),), materials=(GREY,))


def pixels(parts: FaceParts, **options: object) -> np.ndarray:
    """(48, 48, 3) colours 0..255."""
    made = PictureOptions(**{"size": 48, "samples": 4, "background": (0.0, 0.0, 0.0), **options})  # type: ignore[arg-type]
    return np.asarray(picture(parts, None, made)).astype(float)


def linear(values: np.ndarray) -> np.ndarray:
    """Light of colours 0..255."""
    return np.asarray(from_srgb(values / 255))


def turned_camera(seed: int) -> Camera:
    """A camera rolled and off centre that sees the wall."""
    rng = np.random.default_rng(seed)
    yaw, pitch, roll = rng.uniform(-0.4, 0.4, 3)
    right, up, backward = portrait(np.zeros((1, 3)), (yaw, pitch), 48, 48).axes
    axes = np.stack([np.cos(roll) * right + np.sin(roll) * up, np.cos(roll) * up - np.sin(roll) * right, backward])
    middle = np.array([0.0, 2.5, 0.0])
    return Camera(axes=axes, eye=middle + axes[2] * rng.uniform(7, 12), focal=70.0, center=(20.0, 27.0))


def test_the_portraits_own_camera_changes_nothing() -> None:
    parts = wall()
    view = (0.3, -0.2)
    own = portrait(parts.meshes[0].points, view, 48, 48)
    assert (pixels(parts, camera=own) == pixels(parts, view=view)).all()


@pytest.mark.parametrize("seed", range(4))
def test_a_point_is_drawn_where_the_camera_puts_it(seed: int) -> None:
    """The centre of a small triangle's pixels is the projection of its middle."""
    camera = turned_camera(seed)
    middle = np.array([0.4, 2.9, 0.3])
    around = middle + 0.3 * (camera.axes[:2].T @ np.array([[-1.0, 1.0, 0.0], [-1.0, -1.0, 2.0]])).T
    mesh = replace(
        grid_mesh("Mark"), points=around, uv_sets=(), face_vertex_counts=np.array([3]), face_vertex_indices=np.arange(3)
    )
    even = replace(NO_LIGHT, sky=(9.0,) * 3, ground=(9.0,) * 3)
    cover = linear(pixels(FaceParts(meshes=(mesh,)), camera=camera, studio=even))[..., 0]
    row, column = np.indices(cover.shape) + 0.5
    found = np.array([(cover * column).sum(), (cover * row).sum()]) / cover.sum()
    x, y, _, depth = camera.project(middle[None])[0]
    assert np.abs(found - [x / depth, y / depth]).max() < 0.15


def test_studio_portrait_is_the_default_and_no_light_is_black() -> None:
    parts = wall()
    assert (pixels(parts, studio=PORTRAIT) == pixels(parts)).all()
    assert (pixels(parts, studio=NO_LIGHT) == 0).all()


def test_light_comes_from_where_the_studio_has_it() -> None:
    """A matt wall seen head on reflects its colour times the light's, by the cosine of the light's direction."""
    middles = []
    for angle in (0.0, np.pi / 3):
        lamp = Light(direction=(np.sin(angle), 0.0, np.cos(angle)), color=(0.8, 0.4, 0.2), highlight=0.0)
        studio = replace(NO_LIGHT, lights=(lamp,), shadows=False, compress=False)
        middles.append(linear(pixels(wall(), studio=studio))[24, 24])
    assert middles[0] == pytest.approx(np.array([0.4, 0.2, 0.1]), rel=0.03)
    assert middles[1] == pytest.approx(middles[0] / 2, rel=0.03)


def test_a_backdrop_is_seen_where_the_face_is_not() -> None:
    image = np.random.default_rng(0).integers(0, 256, (48, 48, 3)).astype(np.float64)
    seen = pixels(wall(), backdrop=image / 255, camera=turned_camera(0))
    empty = (pixels(wall(), background=(1.0, 1.0, 1.0), camera=turned_camera(0)) == 255).all(axis=2)
    assert 0.1 < empty.mean() < 0.9
    assert np.abs(seen - image)[empty].max() <= 1
