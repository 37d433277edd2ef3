"""Alpha cards and see-through layers: opacity, order, edges; textures that are filtered; normal maps."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from facepipe.geometry.colors import from_srgb
from facepipe.parts import FaceParts, Material, Mesh, Texture, TextureInput, UvSet
from facepipe.pictures import PictureOptions, picture
from facepipe.pictures.lighting import Light, Studio

EVEN = Studio(lights=(), sky=(1.0, 1.0, 1.0), ground=(1.0, 1.0, 1.0), shadows=False, compress=False)
UVS = UvSet(values=np.array([(0, 0), (1, 0), (1, 1), (0, 1)], float))


def sheet(name: str, z: float, pieces: int = 1) -> Mesh:
    """A square from -1 to 1 of pieces * pieces quads, facing the viewer."""
    steps = np.linspace(-1, 1, pieces + 1)
    x, y = np.meshgrid(steps, steps)
    corner = np.arange((pieces + 1) ** 2).reshape(pieces + 1, -1)
    quads = np.stack([corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]], axis=-1).reshape(-1, 4)
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, z)], axis=1)
    return Mesh(
        name=name,
        points=points,
        face_vertex_counts=np.full(len(quads), 4, np.int32),
        face_vertex_indices=quads.ravel().astype(np.int32),
        uv_sets=(UvSet(values=(points[:, :2] + 1) / 2),),
        material=name,
        double_sided=True,
    )


def texture(pixels: np.ndarray, **changes: object) -> TextureInput:
    buffer = io.BytesIO()
    Image.fromarray(pixels.astype(np.uint8)).save(buffer, "PNG")
    return TextureInput(texture=Texture(name=f"{id(pixels)}.png", data=buffer.getvalue()), **changes)  # type: ignore[arg-type]


def matt(name: str, color: tuple[float, float, float], **changes: object) -> Material:
    return replace(Material(name=name, diffuse_color=color, roughness=1.0), **changes)  # type: ignore[arg-type]


def drawn(meshes: list[Mesh], materials: list[Material], **options: object) -> np.ndarray:
    """(64, 64, 3) linear colours on black, in even light."""
    settings = {"size": 64, "samples": 3, "background": (0.0, 0.0, 0.0), "studio": EVEN, **options}
    parts = FaceParts(meshes=tuple(meshes), materials=tuple(materials))
    image = picture(parts, None, PictureOptions(**settings))  # type: ignore[arg-type]
    return np.asarray(from_srgb(np.asarray(image) / 255.0))


@pytest.mark.parametrize("opacity", [0.25, 0.5, 0.75])
def test_a_card_mixes_with_what_is_behind_it(opacity: float) -> None:
    value = round(opacity * 255)
    alpha = texture(np.full((4, 4), value), channels="r")
    for how in (opacity, alpha):
        glowing = matt("Wall", (0.0, 0.0, 0.0), emissive_color=(0.0, 0.6, 0.0))  # no shadow of the card on it
        materials = [glowing, matt("Card", (0.6, 0.0, 0.0), opacity=how)]
        pixel = drawn([sheet("Wall", 0.0), sheet("Card", 0.3)], materials)[32, 32]
        np.testing.assert_allclose(pixel, [0.6 * opacity, 0.6 * (1 - opacity), 0.0], atol=0.01)


def test_many_layers_lie_in_order_whatever_the_order_of_the_meshes() -> None:
    rng = np.random.default_rng(0)
    colors = rng.uniform(0.1, 0.9, (12, 3))
    materials = [matt(f"L{i}", tuple(color), opacity=0.3) for i, color in enumerate(colors)]
    meshes = [sheet(f"L{i}", 0.2 * i) for i in range(12)]
    seen = drawn(meshes, materials)
    order = rng.permutation(12)
    np.testing.assert_array_equal(drawn([meshes[i] for i in order], materials), seen)
    expected = np.zeros(3)
    for color in colors:
        expected = 0.7 * expected + 0.3 * color
    np.testing.assert_allclose(seen[32, 32], expected, atol=0.01)


def test_the_edges_inside_a_card_do_not_show() -> None:
    material = [matt("Card", (0.7, 0.7, 0.7), opacity=0.5)]
    whole, pieces = (drawn([sheet("Card", 0.0, count)], material, view=(0.5, 0.3)) for count in (1, 37))
    assert np.abs(whole - pieces).max() < 0.02


def test_nothing_shines_through_what_is_opaque() -> None:
    """Thin faint strips just before an opaque card, with its material: neither lets the wall behind them through."""
    alpha = texture(np.array([[255] * 7 + [30]]), channels="r")
    card = sheet("Card", 0.3)
    strips = np.arange(-0.9, 0.9, 0.1)
    x = strips[:, None] + np.array([0, 0.01, 0.01, 0])
    points = np.stack([x, np.broadcast_to([-0.9, -0.9, 0.9, 0.9], x.shape), np.full(x.shape, 0.302)], axis=-1)
    points = np.concatenate([card.points, points.reshape(-1, 3)])
    u = np.where(points[:, 2] > 0.301, 15 / 16, 0.3)
    card = replace(
        card,
        points=points,
        face_vertex_counts=np.full(len(points) // 4, 4, np.int32),
        face_vertex_indices=np.append(card.face_vertex_indices, np.arange(4, len(points))).astype(np.int32),
        uv_sets=(UvSet(values=np.stack([u, np.full_like(u, 0.5)], axis=1)),),
    )
    glowing = matt("Wall", (0.0, 0.0, 0.0), emissive_color=(0.0, 0.6, 0.0))
    seen = drawn([sheet("Wall", 0.0), card], [glowing, matt("Card", (0.6, 0.0, 0.0), opacity=alpha)])
    inner = seen[12:52, 12:52, 1] * ~np.fliplr(np.eye(40, dtype=bool))  # without the edge inside the card
    assert inner.max() < 0.01


def test_the_border_of_a_film_is_smooth() -> None:
    pixels = drawn([sheet("Film", 0.0)], [matt("Film", (0.8, 0.8, 0.8), opacity=0.6)], view=(0.3, 0.2))[..., 0]
    partial = (pixels > 0.02) & (pixels < 0.45)
    assert 60 < partial.sum() < 400
    assert len(np.unique(np.round(pixels[partial], 3))) > 5


def test_a_card_through_a_wall_is_cut_where_they_meet() -> None:
    turned = sheet("Card", 0.0)
    turned = replace(turned, points=turned.points @ np.array([[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]]))
    materials = [matt("Wall", (0.0, 0.6, 0.0)), matt("Card", (0.6, 0.0, 0.0), opacity=0.5)]
    row = drawn([sheet("Wall", 0.0), turned], materials)[32]
    assert (row[14:30, 0] > 0.2).all() != (row[34:50, 0] > 0.2).all()
    assert (row[14:30, 0] < 0.01).all() != (row[34:50, 0] < 0.01).all()


def test_a_clear_film_glints_and_what_a_texture_cuts_does_not() -> None:
    lamp = Light(direction=(0.0, 0.0, 1.0), color=(1.0, 1.0, 1.0))
    studio = replace(EVEN, lights=(lamp,), sky=(0.0,) * 3, ground=(0.0,) * 3)
    glossy = {"diffuse_color": (0.0, 0.0, 0.0), "roughness": 0.1}
    film = Material(name="Card", opacity=0.05, **glossy)  # type: ignore[arg-type]
    cut = Material(name="Card", opacity=texture(np.zeros((4, 4)), channels="r"), **glossy)  # type: ignore[arg-type]
    assert drawn([sheet("Card", 0.0)], [film], studio=studio).max() > 0.5
    assert drawn([sheet("Card", 0.0)], [cut], studio=studio).max() == 0


def test_fine_patterns_seen_from_afar_are_their_mean() -> None:
    """A chequer of 256 squares a side on 56 pixels: a grey without a pattern."""
    squares = (np.indices((256, 256)).sum(axis=0) % 2)[..., None] * np.array([255, 255, 255])
    pixels = drawn([sheet("Wall", 0.0)], [matt("Wall", (0.5,) * 3, diffuse_color=texture(squares))], samples=1)
    inner = pixels[12:52, 12:52]
    assert np.ptp(inner) < 0.02
    sparse = (np.indices((256, 256)).sum(axis=0) % 2) * 255
    card = matt("Card", (1.0, 1.0, 1.0), opacity=texture(sparse, channels="r"))
    inner = drawn([sheet("Card", 0.0)], [card], samples=1)[12:52, 12:52]
    np.testing.assert_allclose(inner, 0.5, atol=0.02)


def test_hairs_pass_light_on_to_those_in_their_shade() -> None:
    """Below a roof that a lamp shines on, a card of hairs has a third of its light, and a solid one none."""
    lamp = Light(direction=(0.0, 0.8, 0.6), color=(1.0, 1.0, 1.0), highlight=0.0)
    studio = replace(EVEN, lights=(lamp,), shadows=True, sky=(0.0,) * 3, ground=(0.0,) * 3)
    card, roof = sheet("Card", 0.0), sheet("Roof", 0.0)
    roof = replace(roof, points=roof.points[:, [0, 2, 1]] + [0, 0.3, 0])
    hairs = matt("Card", (0.5,) * 3, opacity=texture(np.full((4, 4), 255), channels="r"))
    shares = []
    for one in (hairs, replace(hairs, opacity=1.0)):
        lit, shaded = (drawn(each, [one, matt("Roof", (0.0,) * 3)], studio=studio) for each in ([card], [card, roof]))
        shares.append(shaded[36, 32, 0] / lit[36, 32, 0])
    assert 0.25 < shares[0] < 0.5
    assert shares[1] < 0.05


@pytest.mark.parametrize("side", [-1, 1])
def test_a_normal_map_turns_the_surface(side: int) -> None:
    """Normals that lean to one side are bright in light from there, and dark in light from the other side."""
    lean = np.array([0.6 * side, 0.0, 0.8])
    pixels = np.tile(np.round((lean + 1) / 2 * 255), (4, 4, 1))
    scaled = {"scale": (2.0, 2.0, 2.0, 1.0), "bias": (-1.0, -1.0, -1.0, 0.0)}
    levels = []
    for x in (-1, 1):
        lamp = Light(direction=(0.6 * x, 0.0, 0.8), color=(1.0, 1.0, 1.0), highlight=0.0)
        studio = replace(EVEN, lights=(lamp,), sky=(0.0,) * 3, ground=(0.0,) * 3)
        wall = matt("Wall", (0.5,) * 3, normal=texture(pixels, **scaled))
        levels.append(drawn([sheet("Wall", 0.0)], [wall], studio=studio)[32, 32, 0])
    expected = [0.5 * max(lean @ [0.6 * x, 0.0, 0.8], 0) for x in (-1, 1)]
    np.testing.assert_allclose(levels, expected, atol=0.01)


def test_a_flat_normal_map_changes_nothing() -> None:
    flat = np.tile(np.array([128, 128, 255]), (4, 4, 1))
    pair = [drawn([sheet("Wall", 0.0)], [matt("Wall", (0.5,) * 3, normal=one)]) for one in (None, texture(flat))]
    np.testing.assert_allclose(pair[0], pair[1], atol=0.01)


def test_emission_occlusion_and_metal_count() -> None:
    def level(**changes: object) -> np.ndarray:
        return drawn([sheet("Wall", 0.0)], [matt("Wall", (0.4, 0.2, 0.1), **changes)])[32, 32]

    plain = level()
    np.testing.assert_allclose(level(emissive_color=(0.0, 0.3, 0.0)) - plain, [0.0, 0.3, 0.0], atol=0.01)
    assert (level(occlusion=0.4) < 0.8 * plain).all()
    assert (level(metallic=1.0) < 0.1 * plain).all()  # a sky has no highlights here, and metal nothing else
