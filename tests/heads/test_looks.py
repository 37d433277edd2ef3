"""Skin, eyes and hairs of the head in the box."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import replace
from importlib.resources import files

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import binary_dilation
from scipy.spatial import cKDTree

from facepipe.core.errors import InputError
from facepipe.geometry.colors import from_srgb
from facepipe.heads import skin
from facepipe.heads.assembly import make_head
from facepipe.heads.asset import arrays
from facepipe.heads.people import BEARDS, BROWS, IRIS, STYLES, Look
from facepipe.heads.surfaces import Cards, card_mesh, card_triangles, cards, dressed
from facepipe.parts import FaceParts, TextureInput

HAIR = [style for style, (_, picture) in STYLES.items() if picture]
GROWN = [beard for beard, painted in BEARDS.items() if painted]
SETS = ("brows", "lashes", *HAIR, *GROWN)
SIZE = 64


@pytest.fixture(scope="module")
def head() -> FaceParts:
    return make_head(np.zeros(100))


@pytest.fixture
def plain_skin(monkeypatch: pytest.MonkeyPatch) -> None:
    """Skin of one grey, where all else of a dressed head is looked at."""
    for name in ("albedo", "roughness", "relief"):
        monkeypatch.setattr(skin, name, lambda look, tile, size: np.full((size, size, 3), 128, np.uint8))


def _seam(head: FaceParts) -> tuple[np.ndarray, np.ndarray]:
    """Texture coordinates of the head's points that lie in both tiles: (m, 2) in each."""
    mesh = head.meshes[0]
    places = {}
    for tile in (0, 1):
        uv = mesh.uv_sets[0].values[mesh.uv_sets[0].indices]
        here = np.floor(uv[:, 0]) == tile
        places[tile] = dict(zip(mesh.face_vertex_indices[here].tolist(), uv[here] - [tile, 0], strict=True))
    inner = {point for point, (u, v) in places[1].items() if v > 0.7 and abs(u - 0.5) > 0.22}  # of mouth and sockets
    shared = sorted((places[0].keys() & places[1].keys()) - inner)
    return tuple(np.array([places[tile][point] for point in shared]) for tile in (0, 1))  # type: ignore[return-value]


@pytest.mark.parametrize(
    "tone", [1.0, pytest.param(5.5, marks=pytest.mark.slow), pytest.param(10.0, marks=pytest.mark.slow)]
)
def test_the_two_tiles_have_one_colour_where_they_meet(head: FaceParts, tone: float) -> None:
    look, size = Look(tone=tone, style="bald"), 1024
    seams = _seam(head)
    assert len(seams[0]) > 100
    colors = []
    for tile, uv in enumerate(seams):
        pixels = skin.albedo(look, tile, size).astype(float)
        column, row = (uv[:, 0] * size).astype(int), ((1 - uv[:, 1]) * size).astype(int)
        colors.append(pixels[row.clip(0, size - 1), column.clip(0, size - 1)])
    apart = np.abs(colors[0] - colors[1]).mean(axis=1)
    assert np.median(apart) < 3  # of 255
    assert np.percentile(apart, 95) < 8


def test_skin_darkens_with_the_tone_and_lips_are_redder_than_cheeks() -> None:
    lips = skin.masks(0)["lips"] > 0.9
    cheeks = skin.masks(0)["cheeks"] > 0.7
    colors = [skin.coarse(Look(tone=float(tone)), 0) for tone in range(1, 11)]
    levels = [color[cheeks].mean() for color in colors]
    assert (np.diff(levels) < 0).all()
    for color in colors:
        assert (
            color[lips][:, 0].mean() / color[lips][:, 1].mean()
            > color[cheeks][:, 0].mean() / color[cheeks][:, 1].mean()
        )


@pytest.mark.parametrize("tone", [1.0, 5.0, 10.0])
def test_caruncles_are_pink_and_wet_and_tears_line_the_lower_lids(head: FaceParts, tone: float) -> None:
    mesh, lids, size, look = head.meshes[0], arrays("lids"), 512, Look(tone=tone, feminine=0.8)
    place = np.zeros((len(mesh.points), 2))
    uv = mesh.uv_sets[0].values[mesh.uv_sets[0].indices]
    here = uv[:, 0] < 1
    place[mesh.face_vertex_indices[here]] = uv[here]
    color = from_srgb(skin.albedo(look, 0, size) / 255)
    maps = np.dstack([color, skin.roughness(look, 0, size)[..., 1] / 255])
    white = np.asarray(Image.open(io.BytesIO((files("facepipe.heads") / "data" / "sclera.png").read_bytes())))
    red, green, _ = from_srgb(white[white[..., 3] > 250][:, :3] / 255).mean(axis=0)

    def seen(points: np.ndarray) -> np.ndarray:
        at = (place[points] * [1, -1] + [0, 1]) * size
        return maps[at[:, 1].astype(int), at[:, 0].astype(int)].mean(axis=0)

    for side, corner in enumerate((42, 39)):  # of the 68 landmarks
        low, ring = lids["lids"][side][~lids["lid_upper"]], lids["lid_rings"][~lids["lid_upper"]]
        inner = mesh.points[mesh.landmarks["multipie68"].indices[corner]]
        far = np.linalg.norm(mesh.points[low] - inner, axis=1)  # cm
        line, beside = seen(low[(ring == 3) & (far > 0.6)]), seen(low[(ring == 9) & (far > 0.6)])
        caruncle = seen(low[(ring >= 4) & (ring <= 5) & (far < 0.25)])
        assert line[3] < 0.15 < 0.35 < beside[3]
        assert line[:3].mean() > beside[:3].mean()
        assert line[2] > 1.1 * beside[2]  # the lightest skin is as light as a rim can be, but yellower
        assert caruncle[3] < 0.25
        assert caruncle[0] / caruncle[1] > 1.5 * red / green
        assert caruncle[0] / caruncle[1] > 1.1 * line[0] / line[1]


def _spread(values: np.ndarray, where: np.ndarray) -> float:
    return float(values[where].std())


def test_old_skin_is_folded_uneven_rough_and_its_lips_pale() -> None:
    """Each sign is stronger at 80 than at 50, and there is none of it at 20."""
    ages, zones = (0.03, 0.52, 1.0), skin.masks(0)
    face = (zones["cheeks"] > 0.3) | (zones["forehead"] > 0.3)
    lips, signs = zones["lips"] > 0.9, []
    for age in ages:
        look = Look(seed=3, age=age, style="bald")
        coarse, slopes = skin.coarse(look, 0), skin.relief(look, 0, 512)[..., :2].astype(float)
        redness = np.median(coarse[lips][:, 0] / coarse[lips][:, 1])
        rough = skin.roughness(look, 0, 512)[..., 1].astype(float)[face].mean()
        signs.append((_spread(np.log(coarse[..., 1]), face), _spread(slopes, face), rough, -redness))
    assert (np.diff(signs, axis=0) > 0).all(), signs


def test_no_two_people_age_alike() -> None:
    folds = [skin.relief(Look(seed=seed, age=1.0), 0, 128).astype(float) for seed in (1, 2)]
    plain = [skin.relief(Look(seed=seed, age=0.0), 0, 128).astype(float) for seed in (1, 2)]
    apart = (folds[0] - plain[0]) - (folds[1] - plain[1])
    assert np.abs(apart[..., :2]).max() > 10


def test_womens_lips_are_redder_and_their_skin_smoother() -> None:
    lips, face = skin.masks(0)["lips"] > 0.9, skin.masks(0)["cheeks"] > 0.5
    found = []
    for feminine in (0.0, 1.0):
        look = Look(feminine=feminine)
        coarse = skin.coarse(look, 0)
        found.append(
            (
                np.median(coarse[lips][:, 0] / coarse[lips][:, 1]),
                -_spread(skin.relief(look, 0, 1024)[::2, ::2, 0], face),
            )
        )
    assert (np.array(found[1]) > np.array(found[0])).all()


def test_brows_of_each_shape_are_where_their_name_says() -> None:
    """Beyond the middle an arched one is higher than a soft one, and a straight one lower; arched ones are thin."""

    def line(name: str) -> tuple[np.ndarray, float]:
        image = Image.open(io.BytesIO((files("facepipe.heads") / "data" / name).read_bytes()))
        alpha = np.asarray(image)[..., 1] / 255
        height = np.arange(len(alpha))[::-1, None] * np.ones_like(alpha)
        pieces = [slice(*ends) for ends in ((100, 250), (450, 750), (850, 950))]
        return np.array([np.average(height[:, one], weights=alpha[:, one]) for one in pieces]), alpha.mean()

    soft, arched, straight = (line(BROWS[shape][-1]) for shape in ("soft", "arched", "straight"))
    assert arched[0][1] - soft[0][1] > 10 > -10 > straight[0][1] - soft[0][1]
    assert arched[1] < 0.6 * straight[1]


@pytest.mark.parametrize("drawn", [skin.albedo, skin.roughness, skin.relief])
def test_the_same_look_gives_the_same_bytes_and_another_seed_others(drawn: Callable[..., np.ndarray]) -> None:
    pictures = [drawn(Look(seed=seed), 0, SIZE).tobytes() for seed in (1, 1, 2)]
    assert pictures[0] == pictures[1] != pictures[2]


@pytest.mark.usefixtures("plain_skin")
@pytest.mark.parametrize(
    "style",
    [pytest.param(one, marks=pytest.mark.slow) if one not in ("bald", "crop", "afro") else one for one in STYLES],
)
def test_every_material_that_a_mesh_asks_for_is_there(head: FaceParts, style: str) -> None:
    look = Look(style=style)
    for size in (SIZE, None):
        made = dressed(head, look, size)
        asked = {material_face.material for mesh in made.meshes for material_face in mesh.material_faces}
        asked |= {mesh.material for mesh in made.meshes}
        assert asked - {None} <= {material.name for material in made.materials}
        assert ("Hair" in asked) == (size is not None and style in HAIR)


@pytest.mark.usefixtures("plain_skin")
@pytest.mark.parametrize("eyes", list(IRIS)[::3])
def test_an_eye_is_clear_before_the_iris_and_white_around_it(head: FaceParts, eyes: str) -> None:
    cornea = next(material for material in dressed(head, Look(eyes=eyes), SIZE).materials if material.name == "Cornea")
    assert isinstance(cornea.opacity, TextureInput)
    alpha = np.asarray(Image.open(io.BytesIO(cornea.opacity.texture.data)))[..., 3] / 255
    middle = len(alpha) // 2
    assert alpha[middle, middle] < 0.1
    assert alpha[middle, middle + int(0.15 * len(alpha)) :].min() == 1.0


@pytest.mark.usefixtures("plain_skin")
@pytest.mark.parametrize("size", [None, SIZE])
@pytest.mark.parametrize("name", ["M_ScleraLeft", "M_IrisRight"])
def test_eyes_are_the_dimmer_the_darker_the_skin_and_the_whites_no_bluer(
    head: FaceParts, name: str, size: int | None
) -> None:
    shown = []
    for tone in (1.0, 5.0, 10.0):
        materials = dressed(head, Look(tone=tone, eyes="blue"), size).materials
        color = next(material for material in materials if material.name == name).diffuse_color
        shown.append(color.scale[:3] if isinstance(color, TextureInput) else color)
    light, middle, dark = (np.array(one) for one in shown)
    assert (light > middle).all()
    assert (middle > dark).all()
    assert 0.5 <= (dark / light).min() <= (dark / light).max() <= 0.65
    assert dark[2] / dark[0] <= light[2] / light[0] + 1e-9
    assert dark[2] / dark[0] > 0.9 * light[2] / light[0]  # not yellow


@pytest.mark.parametrize("name", SETS)
def test_cards_are_held_by_points_of_the_head(head: FaceParts, name: str) -> None:
    held = cards(name)
    np.testing.assert_allclose(held.shares.sum(axis=1), 1.0)
    assert held.shares.min() > -1e-9
    assert held.corners.max() < len(head.meshes[0].points)
    assert np.linalg.norm(held.offsets, axis=1).max() < 25.0
    moved = held.carry(head.meshes[0].points + np.array([1.0, 2.0, 3.0])) - held.carry(head.meshes[0].points)
    np.testing.assert_allclose(moved, np.tile([1.0, 2.0, 3.0], (len(moved), 1)), atol=1e-9)


@pytest.mark.parametrize("name", ["brows", "lashes"])
def test_brows_and_lashes_are_on_the_skin_and_the_same_on_both_sides(head: FaceParts, name: str) -> None:
    made = card_mesh("Cards", cards(name), head.meshes[0], "eyes")
    (grid,) = cards(name).grids
    roots = made.points.reshape(*grid, 3)[:, 0 if name == "lashes" else slice(None)]
    assert np.abs(cards(name).offsets.reshape(*grid, 3)[:, 0]).max() < 0.12
    left, right = roots[roots[..., 0] > 0], roots[roots[..., 0] < 0] * [-1, 1, 1]
    assert len(left) == len(right)
    order = [np.lexsort(side.round(1).T) for side in (left, right)]
    assert np.abs(np.sort(left[order[0]], axis=0) - np.sort(right[order[1]], axis=0)).max() < 0.05


def test_lashes_come_down_with_the_lid(head: FaceParts) -> None:
    made = card_mesh("Lashes", cards("lashes"), head.meshes[0], "eyes")
    blink = next(shape for shape in made.blendshapes if shape.name == "eyeBlinkLeft")
    points = made.points.copy()
    points[blink.point_indices] += blink.offsets
    before, after = (one.reshape(*cards("lashes").grids[0], 3)[:3] for one in (made.points, points))  # left, upper
    upward = [(one[:, -1, 9] - one[:, 0, 9])[:, 1].mean() for one in (before, after)]
    assert upward[1] < upward[0] - 0.3
    assert (after - before)[..., 1].mean() < -0.5
    right = blink.point_indices[made.points[blink.point_indices, 0] < 0]
    assert len(right) == 0


def test_hair_follows_the_skull(head: FaceParts) -> None:
    narrow, wide = (replace(face.meshes[0], blendshapes=()) for face in (head, make_head(np.eye(100)[0] * 2.5)))
    for style in HAIR:
        held = cards(style)
        average, person = (card_mesh("Hair", held, mesh, "forehead") for mesh in (narrow, wide))
        move = person.points - average.points
        np.testing.assert_allclose(move, held.carry(wide.points - narrow.points), atol=1e-9)
        assert average.skin is not None
        np.testing.assert_allclose(average.skin.joint_weights.sum(axis=1), 1.0)


def test_without_textures_the_skin_is_coloured_at_its_points(head: FaceParts) -> None:
    look = Look(tone=6.0)
    made = dressed(head, look, None)
    assert not any(isinstance(value, TextureInput) for material in made.materials for value in vars(material).values())
    colors = made.meshes[0].colors
    assert colors is not None
    lips = [made.meshes[0].landmarks["multipie68"].indices[number] for number in (62, 66)]
    np.testing.assert_allclose(np.median(colors, axis=0), look.skin, rtol=0.35)
    assert (colors[lips, 0] / colors[lips, 1] > 1.15 * look.skin[0] / look.skin[1]).all()


def test_sizes_from_the_smallest_are_made_and_smaller_ones_refused(head: FaceParts) -> None:
    for size in (16, 100):
        made = dressed(head, Look(), size).materials[0]
        assert isinstance(made.diffuse_color, TextureInput)
        assert Image.open(io.BytesIO(made.diffuse_color.texture.data)).size == (size, size)
    with pytest.raises(InputError, match="textures: 15 texels a side"):
        dressed(head, Look(), 15)


def test_normals_of_the_relief_are_unit_and_face_outwards() -> None:
    for tile in (0, 1):
        normals = skin.relief(Look(age=0.9), tile, 1024).astype(float) / 127.5 - 1
        np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1.0, atol=0.02)
        assert np.percentile(normals[..., 2], 1) > 0.7
        np.testing.assert_allclose(normals.mean(axis=(0, 1)), [0.0, 0.0, 1.0], atol=0.03)


def test_upper_and_lower_lashes_are_apart_in_their_picture() -> None:
    """Coarse levels of the picture mix eight of its rows and more: rows that no card shows are empty."""
    alpha = np.asarray(Image.open(io.BytesIO((files("facepipe.heads") / "data" / "lashes.png").read_bytes())))[..., 1]
    v = cards("lashes").uv[:, 1]
    shown = np.zeros(len(alpha), bool)
    for low, high in ((v[v < 0.5].min(), v[v < 0.5].max()), (v[v > 0.5].min(), v[v > 0.5].max())):
        shown[int((1 - high) * len(alpha)) : int((1 - low) * len(alpha)) + 1] = True
    assert alpha[~shown].max() == 0
    gaps = np.diff(np.flatnonzero(np.concatenate([shown, shown[:1]])))
    assert gaps.max() > 16
    assert np.flatnonzero(shown).min() > 8
    assert np.flatnonzero(~shown).max() == len(alpha) - 1


@pytest.mark.parametrize("style", ["bob", "long"])
def test_hair_that_hangs_ends_raggedly_and_has_normals_to_the_outside(head: FaceParts, style: str) -> None:
    held = cards(style)
    made = card_mesh("Hair", held, head.meshes[0], "forehead")
    assert made.normals is not None
    ends = []
    for (points, normals), grid in zip(_layers(held, made.points, made.normals), held.grids, strict=True):
        points, normals = points.reshape(*grid, 3), normals.reshape(*grid, 3)
        ends.append(points[:, -1].mean(axis=1)[:, 1])
        hanging = points[..., 1] < -3.0
        outwards = points[hanging] * [1, 0, 1]
        assert (np.einsum("nc,nc->n", normals[hanging], outwards) > 0).mean() > 0.95
        np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1.0)
    assert 0.4 < np.concatenate(ends).std() < 3


def _layers(held: Cards, *values: np.ndarray) -> list[list[np.ndarray]]:
    """Values (n, ...) of the points of cards, by layers."""
    ends = np.cumsum([int(np.prod(grid)) for grid in held.grids])[:-1]
    return [list(one) for one in zip(*(np.split(value, ends) for value in values), strict=True)]


@pytest.mark.parametrize("beard", GROWN)
def test_a_beard_opens_with_the_jaw(head: FaceParts, beard: str) -> None:
    """Cards below the mouth go down with the chin, those above it stay."""
    skin_mesh = head.meshes[0]
    made = card_mesh("Beard", cards(beard), skin_mesh, None)
    opened, skin_points = made.points.copy(), skin_mesh.points.copy()
    for mesh, points in ((made, opened), (skin_mesh, skin_points)):
        jaw = next(shape for shape in mesh.blendshapes if shape.name == "jawOpen")
        points[jaw.point_indices] += jaw.offsets
    marks = skin_mesh.landmarks["multipie68"].indices
    down = (made.points - opened)[:, 1]
    above = (made.points[:, 1] > skin_mesh.points[marks[51], 1]) & (np.abs(made.points[:, 0]) < 1.0)
    assert np.abs(down[above]).max() < 0.5
    chin = (made.points[:, 1] < skin_mesh.points[marks[57], 1] - 1.0) & (np.abs(made.points[:, 0]) < 2.0)
    if beard != "moustache":
        moved = (skin_mesh.points - skin_points)[marks[8], 1]
        assert moved > 2.0
        assert np.median(down[chin]) == pytest.approx(moved, rel=0.3)
    np.testing.assert_allclose(sum(made.regions.values()), 1.0, atol=1e-6)


@pytest.mark.parametrize("style", HAIR)
def test_a_style_has_6000_triangles_at_most(style: str) -> None:
    assert 1000 < len(card_triangles(cards(style))) <= 6000


@pytest.mark.parametrize("style", HAIR)
def test_the_first_half_of_a_layer_lies_where_all_of_it_does(head: FaceParts, style: str) -> None:
    """Fewer cards are a lower level of detail: roots are as near to those that stay as those to each other."""
    held = cards(style)
    places = held.carry(head.meshes[0].points) + held.offsets
    for (points,), grid in list(zip(_layers(held, places), held.grids, strict=True))[:3]:
        roots = points.reshape(*grid, 3)[:, 0].mean(axis=1)
        half = cKDTree(roots[: len(roots) // 2])
        apart = half.query(half.data, k=2)[0][:, 1]
        assert np.percentile(half.query(roots)[0], 95) < 1.5 * np.median(apart)


@pytest.mark.parametrize("name", ["hair", "coils"])
def test_pictures_of_hair_have_its_colour_where_they_are_clear_and_keep_their_cover_when_small(name: str) -> None:
    """Levels that engines make by averaging have no dark rims, and show as much hair at the threshold of the cards."""
    pixels = np.asarray(Image.open(io.BytesIO((files("facepipe.heads") / "data" / f"{name}.png").read_bytes()))) / 255
    grey, alpha = pixels[..., 0], pixels[..., 1]
    near = binary_dilation(alpha > 0, iterations=4) & (alpha == 0)
    assert grey[near].mean() > 0.85 * np.average(grey, weights=alpha)
    shown = (alpha > 0.35).mean()
    for level in (2, 4, 8):
        small = alpha.reshape(len(alpha) // level, level, -1, level).mean(axis=(1, 3))
        assert (small > 0.35).mean() > 0.85 * shown


def test_locks_are_thin_at_their_tips_and_darker_at_their_roots() -> None:
    """Of the columns for hair that hangs, 128 of 1,024 texels each."""
    pixels = np.asarray(Image.open(io.BytesIO((files("facepipe.heads") / "data" / "hair.png").read_bytes()))) / 255
    for column in np.split(pixels[:, :640], 5, axis=1):
        grey, alpha = column[..., 0], column[..., 1]
        middle, tips = alpha[400:700].mean(), alpha[:200].mean()
        assert tips < 0.35 * middle
        roots, ends = (np.average(grey[rows], weights=alpha[rows]) for rows in (slice(900, 1024), slice(200, 500)))
        assert roots < 0.95 * ends
