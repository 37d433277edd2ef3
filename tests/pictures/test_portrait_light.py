"""Portrait light: no more leaves a surface than arrives, from the side where it stands; soft shadows, hollows, skin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from faces import grid_mesh

from facepipe.geometry.colors import from_srgb
from facepipe.parts import FaceParts, Material, Mesh
from facepipe.pictures import PictureOptions, picture
from facepipe.pictures.draw import open_share, spread
from facepipe.pictures.lighting import PORTRAIT, Portrait, Samples, Softbox, filmic
from facepipe.pictures.occlusion import depth_map

WHITE = (1.0, 1.0, 1.0)
DARK = Softbox(direction=(0.0, 0.0, 1.0), color=(0.0, 0.0, 0.0), size=(0.2, 0.2))
FURNACE = Portrait(boxes=(DARK,), sky=WHITE, ground=WHITE)


def samples(cosine: np.ndarray, base: float, roughness: float, metallic: bool = False, coat: float = 0.0) -> Samples:
    """Surfaces that face up, seen under angles of these cosines."""
    count = len(cosine)
    eye = np.stack([np.sqrt(1 - cosine**2), cosine, np.zeros(count)], axis=1)
    mirror = np.full((count, 3), base if metallic else 0.04, np.float32)
    return Samples(
        normals=np.tile(np.array([0, 1, 0], np.float32), (count, 1)),
        towards_eye=eye.astype(np.float32),
        up=np.array([0, 1, 0], np.float32),
        base=np.full((count, 3), base, np.float32),
        roughness=np.full(count, roughness, np.float32),
        carried=np.ones((count, 8), np.float32),
        mirror=mirror,
        coat=np.full(count, coat, np.float32),
        coat_roughness=np.full(count, 0.05, np.float32),
        inside=np.ones(count, np.float32),
    )


@pytest.mark.parametrize("roughness", [0.02, 0.3, 0.6, 1.0])
def test_a_white_surface_in_even_light_is_lost_in_it(roughness: float) -> None:
    cosine = np.linspace(0.05, 1, 40)
    lit = FURNACE.light(samples(cosine, 1.0, roughness))
    leaving = lit.diffuse + lit.highlights
    assert leaving.max() <= 1.0 + 1e-5
    assert leaving[cosine > 0.3].min() > 0.97
    metal = FURNACE.light(samples(cosine, 0.9, roughness, metallic=True))
    assert metal.highlights.max() <= 1.0 + 1e-5


def test_a_clear_coat_shines_and_takes_light_from_what_it_covers() -> None:
    cosine = np.linspace(0.1, 1, 40)
    bare, coated = (FURNACE.light(samples(cosine, 0.3, 0.9, coat=coat)) for coat in (0.0, 1.0))
    assert (coated.highlights > bare.highlights).all()
    assert (coated.diffuse < bare.diffuse).all()
    white = FURNACE.light(samples(cosine, 1.0, 0.9, coat=1.0))
    assert (white.diffuse + white.highlights).max() <= 1.0 + 1e-5


def test_where_no_sky_is_seen_light_is_fainter_and_red() -> None:
    """As in a mouth, whose walls pass on the light that comes in."""
    teeth = samples(np.array([1.0]), 0.7, 0.3)
    lit, hidden = (FURNACE.light(replace(teeth, carried=teeth.carried * seen)).diffuse[0] for seen in (1.0, 0.0))
    assert (hidden < 0.8 * lit).all()
    assert hidden[0] > hidden[1] > hidden[2] > 0.2 * lit[2]


@pytest.mark.parametrize("roughness", [0.25, 0.5, 0.9])
def test_a_box_gives_no_more_light_than_it_has(roughness: float) -> None:
    """The mean over all views, by the cosine law, of what a surface reflects of a box that it faces."""
    box = replace(DARK, direction=(0.01, 1.0, 0.0), color=WHITE, size=(0.1, 0.1))
    studio = replace(FURNACE, boxes=(box,), sky=(0.0,) * 3, ground=(0.0,) * 3)
    cosine = np.sqrt((np.arange(400) + 0.5) / 400)  # even by the cosine law
    lit = studio.light(samples(cosine, 0.0, roughness))
    assert 0.01 < lit.key_highlights.mean() < 0.08  # 4 % and a little at grazing views


def sphere(rings: int = 40) -> Mesh:
    """A unit sphere."""
    up, around = np.meshgrid(np.linspace(0, np.pi, rings), np.linspace(0, 2 * np.pi, 2 * rings), indexing="ij")
    points = np.stack([np.sin(up) * np.sin(around), np.cos(up), np.sin(up) * np.cos(around)], axis=-1)
    corner = np.arange(rings * 2 * rings).reshape(rings, -1)
    quads = np.stack([corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]], axis=-1).reshape(-1, 4)
    return Mesh(
        name="Ball",
        points=points.reshape(-1, 3) * 10,
        face_vertex_counts=np.full(len(quads), 4, np.int32),
        face_vertex_indices=quads.ravel().astype(np.int32),
    )


def drawn(*meshes: Mesh, **options: object) -> np.ndarray:
    """(96, 96, 3) linear colours on black."""
    made = PictureOptions(**{"size": 96, "samples": 2, "background": (0.0, 0.0, 0.0), **options})  # type: ignore[arg-type]
    return np.asarray(from_srgb(np.asarray(picture(FaceParts(meshes=meshes), None, made)) / 255.0))


@pytest.mark.parametrize(("x", "y"), [(-1.0, 0.0), (1.0, 0.0), (0.0, 1.0), (0.0, -1.0)])
def test_a_box_lights_the_side_where_it_stands(x: float, y: float) -> None:
    box = replace(DARK, direction=(x, y, 0.3), color=WHITE)
    pixels = drawn(sphere(), studio=Portrait(boxes=(box,), sky=(0.0,) * 3, ground=(0.0,) * 3)).sum(axis=2)
    row, column = np.indices(pixels.shape) - 47.5
    middle = np.array([(pixels * column).sum(), -(pixels * row).sum()]) / pixels.sum()
    assert middle @ [x, y] > 10
    assert abs(middle @ [y, x]) < 3


def test_where_things_touch_it_is_darker() -> None:
    """A wall on a floor: the corner gets less light than the open floor."""
    wall = grid_mesh("Wall", size=30)
    x, y = wall.points[:, 0] / np.ptp(wall.points[:, 0]) * 20, wall.points[:, 1] / np.ptp(wall.points[:, 1]) * 20
    flat = np.zeros_like(x)
    wall = replace(wall, points=np.stack([x, y, flat], axis=1), double_sided=True)
    floor = replace(wall, name="Floor", points=np.stack([x, flat, y], axis=1))
    dome = replace(FURNACE, sky=(0.3,) * 3, ground=(0.3,) * 3)
    pixels = drawn(wall, floor, view=(0.0, 0.7), studio=dome).sum(axis=2)
    column = pixels[:, 48]
    covered = np.flatnonzero(column > 0)[1:-1]  # without the outline's pixels, in part background
    corner = covered[np.argmin(column[covered])]
    assert abs(corner - covered.mean()) < 12  # between wall and floor
    assert column[corner] < 0.7 * np.quantile(column[covered], 0.9)


def test_shadows_are_sharp_at_the_contact_and_soft_away_from_it() -> None:
    """The edge of a card's shadow is as wide as the light is, seen from there, times the distance."""
    widths = []
    line = np.stack([np.linspace(-2.0, 2.0, 2001), np.zeros(2001), np.zeros(2001)], axis=1)
    for height in (0.3, 1.2):
        floor = np.array([(-4, -4, 0), (4, -4, 0), (4, 4, 0), (-4, 4, 0)], float)
        card = np.array([(-4, -4, height), (0, -4, height), (0, 4, height), (-4, 4, height)], float)
        light = depth_map(
            np.concatenate([floor, card]),
            np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]),
            np.array([0.0, 0.0, 1.0]),
            768,
        )
        normals = np.tile((0.0, 0.0, 1.0), (2001, 1))
        turns = np.random.default_rng(0).uniform(0, 2 * np.pi, (40, 2001))
        lit = np.mean([light.softly_lit(line, normals, 0.2, turn) for turn in turns], axis=0)
        assert (lit[:500] == 0).all()
        assert (lit[-500:] == 1).all()
        widths.append(((lit > 0.1) & (lit < 0.9)).sum() * 0.002)
    assert widths[0] < 0.5 * widths[1]
    assert 0.1 < widths[1] / (2 * 0.2 * 1.2) < 1.2


def test_scattering_moves_light_within_one_surface_only() -> None:
    light, share, depth = (
        np.zeros((60, 60, 3), np.float32),
        np.ones((60, 60), np.float32),
        np.full((60, 60), 50, np.float32),
    )
    light[:, 30:] = 1.0
    assert np.abs(spread(np.ones_like(light), share, depth, 1.0, 200.0)).max() < 1e-5
    change = spread(light, share, depth, 1.0, 200.0)
    assert change[20:40, 26:30].min() > 0.02
    assert change[20:40, 30:34].max() < -0.02
    assert abs(change[20:40].mean()) < 0.01
    assert np.abs(change[:, :10]).max() < 0.01
    behind = depth.copy()
    behind[:, 30:] = 80
    assert np.abs(spread(light, share, behind, 1.0, 200.0)[:, :29]).max() < 0.01


def test_hollows_are_darker_and_slopes_are_not() -> None:
    row, column = np.indices((60, 60)).astype(np.float32)
    whole = np.ones_like(row)
    slope = 50 + 0.05 * column + 0.08 * row
    inner = (slice(10, 50), slice(10, 50))
    np.testing.assert_allclose(open_share(slope, whole, 1.0, 500.0)[inner], 1.0, atol=1e-4)
    groove = slope + np.where(np.abs(column - 30) < 3, np.float32(0.5), np.float32(0))
    dark = open_share(groove, whole, 1.0, 500.0)
    assert dark[10:50, 30].max() < 0.9
    assert dark[10:50, 10:15].min() > 0.99
    ridge = slope - np.where(np.abs(column - 30) < 3, np.float32(0.5), np.float32(0))
    assert open_share(ridge, whole, 1.0, 500.0)[10:50, 30].min() > 0.99


def test_tones_keep_the_order_of_light() -> None:
    light = np.concatenate([[0.0], np.geomspace(1e-4, 1e3, 400)])[:, None]
    tones = filmic(light)
    assert tones[0] == 0
    assert (np.diff(tones, axis=0) >= 0).all()
    assert tones.max() <= 1


def test_the_portrait_leaves_skin_neither_black_nor_burnt_out() -> None:
    """Light of the portrait on a ball of skin: bright on one side, dark on the other, without a lost tone."""
    skin = Material(name="skin", diffuse_color=(0.6, 0.37, 0.28))
    parts = FaceParts(meshes=(replace(sphere(), material="skin"),), materials=(skin,))
    pixels = np.asarray(picture(parts, None, PictureOptions(size=96, studio=PORTRAIT))).astype(int)
    inside = pixels[30:66, 20:76]
    assert inside.max() < 253
    assert inside.min() > 15
    assert inside[:, :20].mean() > inside[:, -20:].mean() + 25
