"""Pictures: coverage, depth, barycentrics, symmetry, heat maps, and faces that look like faces."""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from faces import grid_mesh
from photo_files import png_of
from PIL import Image
from places import SHARED

from facepipe.core.errors import InputError
from facepipe.geometry.colors import from_srgb, to_srgb
from facepipe.geometry.rasterise import barycentrics, rasterise, screen_triangles
from facepipe.parts import FaceParts, Landmarks, Material, MaterialFaces, Mesh, Texture, TextureInput, UvSet
from facepipe.pictures import HeatMap, PictureOptions, contact_sheet, picture, save_png
from facepipe.pictures.camera import portrait
from facepipe.pictures.draw import hidden
from facepipe.pictures.occlusion import ambient_occlusion, depth_map, depth_maps, sphere_directions
from facepipe.pictures.overlay import NO_VALUE, STATIONS, ticks
from facepipe.pictures.scene import Levels, bilinear


def screen_points(xyw: Iterable[Sequence[float]]) -> np.ndarray:
    """Homogeneous screen points of (x, y, depth)."""
    return np.array([(x * w, y * w, 1.0, w) for x, y, w in xyw])


def one_triangle(xyw: list[tuple[float, float, float]], width: int, height: int) -> np.ndarray:
    return rasterise(screen_triangles(screen_points(xyw), np.array([[0, 1, 2]])), width, height).triangle


def flat(name: str, corners: list[tuple[float, float, float]], **changes: object) -> Mesh:
    """One polygon."""
    count = len(corners)
    mesh = Mesh(
        name=name,
        points=np.array(corners, dtype=float),
        face_vertex_counts=np.array([count], np.int32),
        face_vertex_indices=np.arange(count, dtype=np.int32),
        double_sided=True,
    )
    return replace(mesh, **changes)  # type: ignore[arg-type]


def square(name: str, z: float, half: float = 1.0, **changes: object) -> Mesh:
    return flat(name, [(-half, -half, z), (half, -half, z), (half, half, z), (-half, half, z)], **changes)


def colored(name: str, color: tuple[float, float, float], **changes: object) -> Material:
    return replace(Material(name=name, diffuse_color=color, roughness=1.0), **changes)  # type: ignore[arg-type]


def test_a_material_that_the_face_lacks_is_drawn_as_none() -> None:
    """As where its surface is connected to a prim instead of a property."""
    subset = (MaterialFaces(material="gone", faces=np.zeros(1, np.int32)),)
    meshes = [square("one", 0.0), square("one", 0.0, material="gone"), square("one", 0.0, material_faces=subset)]
    plain, whole, some = (drawn(FaceParts(meshes=(mesh,))) for mesh in meshes)
    np.testing.assert_array_equal(whole, plain)
    np.testing.assert_array_equal(some, plain)


def drawn(parts: FaceParts, points: np.ndarray | None = None, **options: object) -> np.ndarray:
    """(h, w, 3) pixels as integers."""
    made = PictureOptions(**{"size": 64, "samples": 2, **options})  # type: ignore[arg-type]
    return np.asarray(picture(parts, points, made)).astype(int)


def covered(pixels: np.ndarray, background: int = 0) -> np.ndarray:
    return (pixels != background).any(axis=2)


# Rasteriser


def test_coverage_is_the_area_of_random_triangles() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        xy = rng.uniform(0, 200, (3, 2))
        (ax, ay), (bx, by) = xy[1] - xy[0], xy[2] - xy[0]
        perimeter = np.linalg.norm(xy - np.roll(xy, 1, axis=0), axis=1).sum()
        ids = one_triangle([(*xy[0], 1.0), (*xy[1], 1.0), (*xy[2], 1.0)], 200, 200)
        assert abs((ids == 0).sum() - abs(ax * by - ay * bx) / 2) <= 0.25 * perimeter + 2


def test_pixels_are_exactly_the_centres_inside() -> None:
    rng = np.random.default_rng(1)
    rows, columns = np.mgrid[0:40, 0:40] + 0.5
    for _ in range(50):
        xy = rng.uniform(-10, 50, (3, 2))
        sides = [
            (q[0] - p[0]) * (rows - p[1]) - (q[1] - p[1]) * (columns - p[0])
            for p, q in zip(xy, np.roll(xy, -1, axis=0), strict=True)
        ]
        inside = (np.array(sides) > 0).all(axis=0) | (np.array(sides) < 0).all(axis=0)
        ids = one_triangle([(*xy[0], 2.0), (*xy[1], 2.0), (*xy[2], 2.0)], 40, 40)
        np.testing.assert_array_equal(ids == 0, inside)


def test_a_triangulated_patch_has_no_gaps_and_no_double_hits() -> None:
    rng = np.random.default_rng(2)
    mesh = grid_mesh(size=12)
    xy = mesh.points[:, :2] * 20 + 140 + rng.uniform(-6, 6, (144, 2))
    border = np.ptp(mesh.points[:, :2], axis=0)
    edge = (np.abs(mesh.points[:, 0]) == border[0] / 2) | (mesh.points[:, 1] == 0) | (mesh.points[:, 1] == border[1])
    xy[edge] = (mesh.points[:, :2] * 20 + 140)[edge]
    quads = mesh.face_vertex_indices.reshape(-1, 4)
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    points = screen_points([(x, y, 1.0) for x, y in xy])
    count = np.zeros((400, 400), int)
    for triangle in triangles:
        count += rasterise(screen_triangles(points, triangle[None]), 400, 400).triangle == 0
    assert count.max() == 1
    assert count.sum() == 220 * 220
    assert (rasterise(screen_triangles(points, triangles), 400, 400).triangle >= 0).sum() == 220 * 220


def test_nearer_triangles_occlude_whatever_the_order() -> None:
    rng = np.random.default_rng(3)
    points = screen_points([(*rng.uniform(0, 60, 2), rng.uniform(1, 3)) for _ in range(90)])
    triangles = np.arange(90).reshape(30, 3)
    first = rasterise(screen_triangles(points, triangles), 60, 60)
    order = rng.permutation(30)
    second = rasterise(screen_triangles(points, triangles[order]), 60, 60)
    np.testing.assert_array_equal(first.nearness, second.nearness)
    hit = first.triangle >= 0
    np.testing.assert_array_equal(first.triangle[hit], order[second.triangle[hit]])
    depth = np.zeros((30, 60, 60), np.float32)
    for number, triangle in enumerate(triangles):
        depth[number] = rasterise(screen_triangles(points, triangle[None]), 60, 60).nearness
    np.testing.assert_array_equal(depth.max(axis=0), first.nearness)
    np.testing.assert_array_equal(depth.argmax(axis=0)[hit], first.triangle[hit])


def test_barycentrics_lead_back_to_the_pixels() -> None:
    rng = np.random.default_rng(4)
    world = rng.uniform(-1, 1, (60, 3))
    triangles = np.arange(60).reshape(20, 3)
    camera = portrait(world, (0.4, -0.2), 120, 120)
    points = camera.project(world)
    raster = rasterise(screen_triangles(points, triangles), 120, 120)
    row, column = np.nonzero(raster.key)
    ids = raster.triangle[row, column]
    weights = barycentrics(points, triangles, ids, column + 0.5, row + 0.5)
    back = camera.project(np.einsum("mk,mkc->mc", weights, world[triangles[ids]]))
    np.testing.assert_allclose(back[:, 0] / back[:, 3], column + 0.5, atol=1e-6)
    np.testing.assert_allclose(back[:, 1] / back[:, 3], row + 0.5, atol=1e-6)
    np.testing.assert_allclose(1 / back[:, 3], raster.nearness[row, column], rtol=1e-5)
    assert len(row) > 2000


def test_triangles_through_the_camera_plane_are_cut_not_mirrored() -> None:
    # A floor that runs from far ahead to behind the viewer: everything below the horizon, nothing above it.
    corners = np.array([(-1e3, -1.0, -1e3), (1e3, -1.0, -1e3), (1e3, -1.0, 1e3), (-1e3, -1.0, 1e3)])
    camera = replace(portrait(np.zeros((1, 3)), "front", 64, 64), eye=np.zeros(3), focal=64.0)
    points = camera.project(corners)
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    raster = rasterise(screen_triangles(points, triangles), 64, 64)
    assert (raster.triangle[:32] == -1).all()
    assert (raster.triangle[33:] >= 0).all()
    row, column = np.nonzero(raster.key)
    ids = raster.triangle[row, column]
    hit = np.einsum(
        "mk,mkc->mc", barycentrics(points, triangles, ids, column + 0.5, row + 0.5), corners[triangles[ids]]
    )
    np.testing.assert_allclose(hit[:, 2], -64.0 / (row + 0.5 - 32.0), rtol=1e-6)  # where the pixel's ray meets y = -1


@pytest.mark.parametrize(
    ("corners", "size", "drawn"),
    [
        pytest.param([(0, 0, -1.0), (60, 0, -2.0), (0, 60, -1.0)], (64, 64), -1, id="behind the camera"),
        pytest.param([(-1e5, -1e5, 1.0), (3e5, -1e5, 1.0), (-1e5, 3e5, 1.0)], (500, 300), 0, id="over all the screen"),
        pytest.param([(5, 5, 1.0), (5, 5, 1.0), (30, 30, 1.0)], (64, 64), -1, id="sliver"),
    ],
)
def test_one_triangle_covers_all_pixels_or_none(
    corners: list[tuple[float, float, float]], size: tuple[int, int], drawn: int
) -> None:
    assert (one_triangle(corners, *size) == drawn).all()


# Camera


@pytest.mark.parametrize("view", ["front", "side", "three-quarter", (-2.5, 0.9)])
def test_framing_keeps_all_points_inside_and_fills_the_frame(view: str | tuple[float, float]) -> None:
    points = np.random.default_rng(5).normal(size=(500, 3)) * (1, 2, 1.5) + (30, -20, 7)
    screen = portrait(points, view, 200, 180, right=40).project(points)
    x, y = screen[:, 0] / screen[:, 3], screen[:, 1] / screen[:, 3]
    assert x.min() >= 0
    assert x.max() <= 160
    assert y.min() >= 0
    assert y.max() <= 180
    assert max(np.ptp(x) / 160, np.ptp(y) / 180) > 0.7


def test_views_show_the_right_side_in_both_up_axes() -> None:
    # Red nose ahead, blue ear on the subject's left, green crown on top.
    materials = (colored("red", (0.8, 0, 0)), colored("green", (0, 0.8, 0)), colored("blue", (0, 0, 0.8)))

    def marker(name: str, center: tuple[float, float, float], z_up: bool) -> Mesh:
        cube = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.3 + center
        if z_up:
            cube = np.stack([cube[:, 0], -cube[:, 2], cube[:, 1]], axis=1)
        quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
        return Mesh(
            name=name,
            points=cube,
            face_vertex_counts=np.full(6, 4, np.int32),
            face_vertex_indices=quads.astype(np.int32).ravel(),
            material=name,
        )

    def face(z_up: bool) -> FaceParts:
        centers = {"red": (0.0, 0.0, 2.0), "green": (0.0, 2.0, 0.0), "blue": (2.0, 0.0, 0.0)}
        meshes = tuple(marker(name, center, z_up) for name, center in centers.items())
        return FaceParts(up_axis="Z" if z_up else "Y", meshes=meshes, materials=materials)

    front = drawn(face(False), background=(0.0, 0.0, 0.0))
    strongest = front.argmax(axis=2)
    center = {c: np.argwhere(covered(front) & (strongest == c)).mean(axis=0) for c in range(3)}
    assert center[1][0] < center[0][0] - 15  # the crown above the nose
    assert center[2][1] > center[0][1] + 15  # the subject's left at the viewer's right
    side = drawn(face(False), view="side", background=(0.0, 0.0, 0.0))
    nose = np.argwhere(covered(side) & (side.argmax(axis=2) == 0)).mean(axis=0)
    assert nose[1] < 32 - 10  # seen from the subject's left, the nose points to the viewer's left
    for view in ("front", "side", "three-quarter"):
        np.testing.assert_array_equal(drawn(face(True), view=view), drawn(face(False), view=view))


# Shading


def test_a_mirror_symmetric_face_gives_a_mirror_symmetric_heat_map() -> None:
    mesh = grid_mesh(size=20)
    x, y = mesh.points[:, 0], mesh.points[:, 1]
    points = np.stack([x, y, 6 * np.exp(-(x**2 + (y - 9) ** 2) / 30)], axis=1)
    quads = mesh.face_vertex_indices.reshape(-1, 4).copy()
    quads[points[quads, 0].mean(axis=1) > 0] = np.roll(quads[points[quads, 0].mean(axis=1) > 0], 1, axis=1)
    parts = FaceParts(meshes=(replace(mesh, points=points, face_vertex_indices=quads.astype(np.int32).ravel()),))
    heat = HeatMap(values=np.abs(x))
    pixels = drawn(parts, size=120, samples=3, heatmap=heat)
    assert covered(pixels, 0).any()
    difference = np.abs(pixels - pixels[:, ::-1]).max(axis=2)
    assert np.quantile(difference, 0.99) <= 3
    assert difference.max() <= 40
    assert pixels.std() > 20


def test_edges_are_blends_of_both_sides() -> None:
    tilted = flat("Sheet", [(-1.0, -0.8, 0.0), (1.0, -1.0, 0.0), (0.9, 1.0, 0.0), (-0.9, 0.7, 0.0)], material="white")
    pixels = drawn(
        FaceParts(meshes=(tilted,), materials=(colored("white", (1.0, 1.0, 1.0)),)),
        samples=4,
        background=(0.0, 0.0, 0.0),
    )
    inside = pixels[32, 32].max()
    partial = (pixels.max(axis=2) > 5) & (pixels.max(axis=2) < 0.9 * inside)
    assert 60 < partial.sum() < 400  # along the outline, and nowhere else
    assert len(np.unique(pixels[partial])) > 8


def test_opacity_blends_and_zero_is_not_drawn() -> None:
    def center(opacity: float) -> np.ndarray:
        materials = (colored("wall", (0.0, 0.5, 0.0)), colored("film", (0.5, 0.0, 0.0), opacity=opacity))
        meshes = (square("Wall", 0.0, material="wall"), square("Film", 0.2, material="film"))
        return from_srgb(drawn(FaceParts(meshes=meshes, materials=materials), size=32)[16, 16] / 255)

    clear, half, solid = center(0.0), center(0.5), center(1.0)
    assert clear[1] > 5 * clear[0]
    assert solid[0] > 5 * solid[1]
    assert abs(half[0] - solid[0] / 2) < 0.15 * solid[0]
    assert abs(half[1] - clear[1] / 2) < 0.15 * clear[1]


def test_see_through_layers_blend_from_back_to_front_whatever_the_order() -> None:
    materials = (colored("red", (0.8, 0, 0), opacity=0.5), colored("blue", (0, 0, 0.8), opacity=0.5))
    near, far = square("Near", 0.3, material="red"), square("Far", 0.0, material="blue")
    first = drawn(FaceParts(meshes=(near, far), materials=materials), background=(0.0, 0.0, 0.0))
    second = drawn(FaceParts(meshes=(far, near), materials=materials), background=(0.0, 0.0, 0.0))
    np.testing.assert_array_equal(first, second)
    linear = from_srgb(first[32, 32] / 255)
    assert 1.5 < linear[0] / linear[2] < 2.6  # the near layer counts 1/2, the far one 1/4


def test_textures_lie_where_the_uvs_put_them() -> None:
    # Red at the top left, green at the top right, blue at the bottom left, white at the bottom right.
    texels = np.array([[(255, 0, 0), (0, 255, 0)], [(0, 0, 255), (255, 255, 255)]], np.uint8)
    uv = UvSet(values=np.array([(0, 0), (1, 0), (1, 1), (0, 1)], float), indices=np.arange(4, dtype=np.int32))
    mesh = square("Wall", 0.0, uv_sets=(uv,), material="painted", colors=np.zeros((4, 3)))
    texture = TextureInput(texture=Texture(name="paint.png", data=png_of(texels.repeat(8, 0).repeat(8, 1))))
    parts = FaceParts(meshes=(mesh,), materials=(Material(name="painted", diffuse_color=texture, roughness=1.0),))
    pixels = drawn(parts)
    assert pixels[16, 16].argmax() == 0
    assert pixels[16, 48].argmax() == 1
    assert pixels[48, 16].argmax() == 2
    assert np.ptp(pixels[48, 48]) < 40
    broken = replace(texture, texture=Texture(name="paint.png", data=b"not an image"))
    with pytest.raises(InputError, match=r"paint\.png"):
        drawn(replace(parts, materials=(replace(parts.materials[0], diffuse_color=broken),)))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("far", [1e9, 3e38])
def test_uvs_beyond_all_textures_are_drawn_quietly(far: float) -> None:
    uv = UvSet(values=far * np.array([(0, 0), (1, 0), (1, 1), (0, 1)]))
    texture = TextureInput(texture=Texture(name="a.png", data=png_of(np.full((4, 4, 3), 200, np.uint8))))
    material = Material(name="painted", diffuse_color=texture, normal=texture, roughness=1.0)
    wall = square("Wall", 0.0, uv_sets=(uv,), material="painted")
    assert drawn(FaceParts(meshes=(wall,), materials=(material,)))[32, 32].min() > 60


def test_alpha_test_cuts_by_the_texture() -> None:
    texels = np.zeros((8, 8, 4), np.uint8)
    texels[:, 4:, 3] = 255
    uv = UvSet(values=np.array([(0, 0), (1, 0), (1, 1), (0, 1)], float))
    alpha = TextureInput(texture=Texture(name="a.png", data=png_of(texels)), channels="a", wrap_s="clamp")
    card = Material(name="card", diffuse_color=(0.8, 0, 0), opacity=alpha, opacity_threshold=0.5)
    parts = FaceParts(meshes=(square("Card", 0.0, uv_sets=(uv,), material="card"),), materials=(card,))
    pixels = drawn(parts, background=(0.0, 0.0, 0.0))
    assert (pixels[32, :31] == 0).all()
    assert (pixels[32, 34:55, 0] > 60).all()


def test_colours_by_precedence_of_points_then_material_then_clay() -> None:
    painted = square("Wall", 0.0, colors=np.tile((0.0, 0.0, 0.6), (4, 1)), material="green")
    materials = (colored("green", (0.0, 0.6, 0.0)), colored("red", (0.6, 0.0, 0.0)))
    by_face = (MaterialFaces(material="red", faces=np.array([0], np.int32)),)
    assert drawn(FaceParts(meshes=(painted,), materials=materials))[32, 32].argmax() == 2
    plain = replace(painted, colors=None)
    assert drawn(FaceParts(meshes=(plain,), materials=materials))[32, 32].argmax() == 1
    assert drawn(FaceParts(meshes=(replace(plain, material_faces=by_face),), materials=materials))[32, 32].argmax() == 0
    red, green, blue = drawn(FaceParts(meshes=(replace(plain, material=None),)))[32, 32]
    assert red > green > blue > 60


def test_the_inside_of_a_single_sided_mesh_is_darker() -> None:
    front = square("Wall", 0.0, double_sided=False)
    back = replace(front, face_vertex_indices=front.face_vertex_indices[::-1].copy())
    two_sided = replace(back, double_sided=True)
    levels = [drawn(FaceParts(meshes=(mesh,)))[32, 32].mean() for mesh in (front, back, two_sided)]
    assert levels[1] < 0.75 * levels[0]
    assert abs(levels[2] - levels[0]) < 3


def test_mirrored_transforms_keep_the_outside_outside() -> None:
    wall = square("Wall", 0.0, double_sided=False)
    mirrored = replace(
        wall, transform=np.diag([-1.0, 1, 1, 1]), face_vertex_indices=wall.face_vertex_indices[::-1].copy()
    )
    # Reversed winding and a mirror are each an inversion; a mirrored mesh's winding is judged after the mirror.
    inside = replace(wall, face_vertex_indices=wall.face_vertex_indices[::-1].copy())
    difference = drawn(FaceParts(meshes=(mirrored,))) - drawn(FaceParts(meshes=(inside,)))
    assert np.abs(difference).max() <= 2


def test_points_split_at_a_seam_shade_as_if_they_were_not() -> None:
    mesh = grid_mesh(size=9)
    x, y = mesh.points[:, 0], mesh.points[:, 1]
    mesh = replace(mesh, points=np.stack([x, y, 3 * np.cos(x / 3) * np.cos((y - 4) / 3)], axis=1))
    corners = mesh.face_vertex_indices
    split = replace(mesh, points=mesh.points[corners], face_vertex_indices=np.arange(len(corners), dtype=np.int32))
    split = replace(split, uv_sets=())
    difference = np.abs(drawn(FaceParts(meshes=(mesh,))) - drawn(FaceParts(meshes=(split,))))
    assert difference.max() <= 3


def test_ambient_occlusion_knows_open_sky_and_deep_pits() -> None:
    ground = grid_mesh(size=9).points[:, [0, 2, 1]] - (0, 0, 4)
    lid = ground + np.array([0, 0.3, 0])
    quads = grid_mesh(size=9).face_vertex_indices.reshape(-1, 4)
    triangles = np.concatenate([quads[:, [0, 2, 1]], quads[:, [0, 3, 2]]])
    up = np.tile((0.0, 1.0, 0.0), (81, 1))
    np.testing.assert_allclose(ambient_occlusion(ground, up, triangles), 1.0, atol=0.02)
    both = np.concatenate([ground, lid])
    covered_ground = ambient_occlusion(both, np.concatenate([up, up]), np.concatenate([triangles, triangles + 81]))[:81]
    middle = np.abs(ground).max(axis=1) < 2.5
    assert covered_ground[middle].max() < 0.1


def test_directions_of_the_sky_are_even() -> None:
    directions = sphere_directions(24)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0)
    np.testing.assert_allclose(directions[12:], -directions[:12])
    np.testing.assert_allclose(directions.T @ directions / 24, np.eye(3) / 3, atol=0.06)
    mirrored = np.abs(directions[:, None] * (-1, 1, 1) - directions).max(axis=2).min(axis=0)
    np.testing.assert_allclose(mirrored, 0.0, atol=1e-12)


def test_two_lights_face_to_face_see_what_each_sees_alone() -> None:
    rng = np.random.default_rng(1)
    points, triangles = rng.uniform(-1, 1, (180, 3)), np.arange(180).reshape(-1, 3)
    normals = rng.normal(size=points.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    towards = np.array([0.3, 0.8, -0.5])
    for light, way in zip(depth_maps(points, triangles, towards, 256), (towards, -towards), strict=True):
        alone = depth_map(points, triangles, way, 256)
        both = [one.lit(points + 0.2 * normals, normals) for one in (light, alone)]
        assert 0.1 < np.mean(both[1]) < 0.9
        assert np.mean(np.abs(both[0] - both[1]) > 0.1) < 0.02  # pixels differ, as the maps lie mirrored


def test_what_hides_triangles_hides_all_of_them() -> None:
    """A triangle that is sorted out has no pixel before what stands there; many are sorted out."""
    rng = np.random.default_rng(3)
    start = rng.uniform(-30, 90, (500, 1, 2))
    corners = start + rng.normal(scale=rng.choice([1, 5, 30], (500, 1, 1)), size=(500, 3, 2))
    depth = rng.uniform(1, 3, (500, 3))
    points = screen_points(np.dstack([corners, depth]).reshape(-1, 3))
    screen = screen_triangles(points, np.arange(1500).reshape(-1, 3))
    nearness = np.repeat(np.repeat(rng.uniform(0.3, 1.0, (5, 7)), 4, axis=0), 4, axis=1).astype(np.float32)
    found = hidden(screen, nearness, 3, 2)
    behind = np.repeat(np.repeat(nearness, 3, axis=0), 3, axis=1)
    shows = np.array(
        [(rasterise(screen.take([one]), 84, 84, rows=(6, 66)).nearness > behind).any() for one in range(len(found))]
    )
    assert not (found & shows).any()
    assert found.sum() > 0.3 * (~shows).sum()  # some are beside the band


def test_shadows_fall_away_from_the_light() -> None:
    floor = square("Floor", 0.0, 4.0).points
    card = square("Card", 1.0, 1.0).points
    triangles = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    light = depth_map(np.concatenate([floor, card]), triangles, np.array([1.0, 0.0, 1.0]), 256)
    at = np.array([(-1.0, 0.0, 0.0), (1.0, 0.0, 0.0), (-1.0, 2.0, 0.0), (-3.0, 0.0, 0.0)])
    lit = light.lit(at, np.tile((0.0, 0.0, 1.0), (4, 1)))
    np.testing.assert_allclose(lit, [0, 1, 1, 1])  # the card's shadow is moved one unit towards -X


# Heat maps and text


def test_heat_colours_at_the_ends_and_without_a_value() -> None:
    def center(value: float) -> np.ndarray:
        heat = HeatMap(values=np.full(4, value), range=(0.0, 2.0))
        pixels = drawn(FaceParts(meshes=(square("Wall", 0.0),)), size=32, heatmap=heat)
        return from_srgb(pixels[16, 16] / 255)

    for value, wanted in ((0.0, STATIONS[0]), (2.0, STATIONS[-1]), (9.0, STATIONS[-1]), (np.nan, np.array(NO_VALUE))):
        np.testing.assert_allclose(to_srgb(center(value)), wanted, atol=0.06)


def test_the_bar_shows_the_colours_of_the_range() -> None:
    parts = FaceParts(meshes=(square("Wall", 0.0),))
    pixels = drawn(parts, size=256, heatmap=HeatMap(values=np.array([0.0, 1.0, 2.0, 3.0]), label="error"))
    colors = {tuple(pixel) for pixel in pixels[:, 200:].reshape(-1, 3)}
    for station in (STATIONS[0], STATIONS[5], STATIONS[-1]):
        wanted = np.round(station * 255)
        assert min(np.abs(np.array(color) - wanted).max() for color in colors) <= 6


def test_ticks_are_round_numbers_inside_the_range() -> None:
    assert [text for _, text in ticks(0.0, 3.0)] == ["0", "1", "2", "3"]
    assert [text for _, text in ticks(-0.02, 0.05)] == ["-0.02", "0", "0.02", "0.04"]
    assert HeatMap(values=np.array([0.0, 0.037, np.nan])).limits == (0.0, pytest.approx(0.04))
    assert HeatMap(values=np.full(3, np.nan)).limits == (0.0, 1.0)
    low, high = HeatMap(values=np.array([-3.0, 1.0])).limits
    assert low <= -3.0 < 1.0 <= high


def test_heat_maps_are_checked() -> None:
    with pytest.raises(InputError, match="infinite"):
        HeatMap(values=np.array([0.0, np.inf]))


def test_landmarks_are_dots_where_the_points_are() -> None:
    marks = {"corners": Landmarks(indices=np.array([0, 2], np.int32))}
    parts = FaceParts(meshes=(square("Wall", 0.0, landmarks=marks),))
    plain, marked = drawn(parts, size=200), drawn(parts, size=200, landmarks="corners")
    red = (np.abs(marked - plain).max(axis=2) > 30) & (marked[..., 0] > 200) & (marked[..., 1] < 80)
    found = np.argwhere(red)
    low, high = found[found[:, 0] > 100].mean(axis=0), found[found[:, 0] < 100].mean(axis=0)
    reach = 100 * (1 - 0.12)
    np.testing.assert_allclose(low + 0.5, (100 + reach, 100 - reach), atol=1.0)
    np.testing.assert_allclose(high + 0.5, (100 - reach, 100 + reach), atol=1.0)
    with pytest.raises(InputError, match="corners"):
        drawn(parts, landmarks="nope")


# Pictures


def test_an_empty_face_is_background() -> None:
    assert (drawn(FaceParts(), background=(1.0, 0.0, 0.0)) == (255, 0, 0)).all()
    lonely = Mesh(
        name="Points",
        points=np.zeros((3, 3)),
        face_vertex_counts=np.zeros(0, np.int32),
        face_vertex_indices=np.zeros(0, np.int32),
    )
    assert (drawn(FaceParts(meshes=(lonely,)), background=(1.0, 0.0, 0.0)) == (255, 0, 0)).all()


def test_bands_join_without_a_trace(monkeypatch: pytest.MonkeyPatch) -> None:
    parts = FaceParts(meshes=(grid_mesh(), square("Film", 1.0, material="film")), materials=_film())
    whole = drawn(parts, view="three-quarter")
    monkeypatch.setattr("facepipe.pictures.draw.SAMPLES_PER_BAND", 64 * 4 * 7)
    np.testing.assert_array_equal(drawn(parts, view="three-quarter"), whole)


def test_chunks_of_fragments_join_without_a_trace(monkeypatch: pytest.MonkeyPatch) -> None:
    parts = FaceParts(meshes=(grid_mesh(),))
    whole = drawn(parts, view="three-quarter")
    monkeypatch.setattr("facepipe.geometry.rasterise.ROWS_PER_CHUNK", 50)
    monkeypatch.setattr("facepipe.geometry.rasterise.FRAGMENTS_PER_CHUNK", 100)
    np.testing.assert_array_equal(drawn(parts, view="three-quarter"), whole)


def test_same_input_same_bytes(tmp_path: Path) -> None:
    parts = FaceParts(meshes=(grid_mesh(),))
    options = PictureOptions(size=160, heatmap=HeatMap(values=np.arange(36.0), label="index"))
    for name in ("first.png", "second.png"):
        save_png(picture(parts, None, options), tmp_path / name)
    assert (tmp_path / "first.png").read_bytes() == (tmp_path / "second.png").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["first.png", "second.png"]
    with pytest.raises(InputError, match="folder"):
        save_png(picture(parts, None, options), tmp_path / "gone" / "first.png")


def test_points_are_checked() -> None:
    parts = FaceParts(meshes=(grid_mesh(),))
    bad = grid_mesh().points.copy()
    bad[3, 1] = np.nan
    with pytest.raises(InputError, match="1 of 36 are not finite"):
        drawn(parts, bad)
    with pytest.raises(InputError, match=r"expected \(36, 3\)"):
        drawn(parts, bad[:-1])


def test_framing_holds_the_camera_still() -> None:
    parts = FaceParts(meshes=(square("Wall", 0.0),))
    rest = parts.meshes[0].points
    black = {"background": (0.0, 0.0, 0.0)}
    still = covered(drawn(parts, rest * 0.5, framing=rest, **black)).sum()
    full = covered(drawn(parts, rest * 0.5, **black)).sum()
    assert full == pytest.approx(4 * still, rel=0.1)


def test_contact_sheet_holds_every_picture_and_caption() -> None:
    tiles = [(f"tile {i}", Image.new("RGB", (60, 50), (40 * i, 0, 200))) for i in range(5)]
    sheet = np.asarray(contact_sheet(tiles, 2)).astype(int)
    for _, image in tiles:
        color = np.array(image.getpixel((0, 0)))
        assert (sheet == color).all(axis=2).sum() == 60 * 50
    assert (sheet.max(axis=2) < 120).sum() > 100  # ink of the captions


def test_ict_looks_like_a_face() -> None:
    source = SHARED / "ict_facekit" / "ict_facekit.npz"
    if not source.is_file():
        pytest.skip("needs ../shared/data/ict_facekit, which is not there")
    arrays = np.load(source)
    corners = int(arrays["part_face_range"][4][1])  # face, head and neck, sockets: one welded mesh
    counts = arrays["face_vertex_counts"][:corners]
    head = Mesh(
        name="Head",
        points=arrays["neutral"],
        face_vertex_counts=counts,
        face_vertex_indices=arrays["face_vertex_indices"][: counts.sum()],
        landmarks={"multipie68": Landmarks(indices=arrays["landmarks_multipie68"])},
    )
    pixels = drawn(FaceParts(meshes=(head,)), size=200)
    cheeks = pixels[85:112, 76:90].reshape(-1, 3)
    assert (cheeks[:, 0] > cheeks[:, 2] + 10).all()  # warm
    assert 90 < cheeks.mean() < 245  # neither black nor burnt out
    for corner in (pixels[:12, :12], pixels[:12, -12:], pixels[-12:, :12], pixels[-12:, -12:]):
        assert (np.ptp(corner, axis=2) < 16).all()  # grey
        assert corner.mean() > 150
    figure = np.abs(pixels - drawn(FaceParts(), size=200)).max(axis=2) > 12
    assert 0.3 < figure.mean() < 0.6
    assert (pixels[figure].max(axis=1) < 40).mean() < 0.02  # no black blotches


def _film() -> tuple[Material, ...]:
    return (colored("film", (0.2, 0.5, 0.2), opacity=0.4),)


def test_bilinear_sampling_meets_texels_and_their_means() -> None:
    texels = np.random.default_rng(6).random((4, 5, 3)).astype(np.float32)
    rows, columns = np.divmod(np.arange(20), 5)
    uv = np.stack([(columns + 0.5) / 5, 1 - (rows + 0.5) / 4], axis=1)
    np.testing.assert_allclose(bilinear(texels, uv), texels.reshape(-1, 3), atol=1e-6)
    np.testing.assert_allclose(bilinear(texels, uv + np.array([3, -2])), texels.reshape(-1, 3), atol=1e-5)
    np.testing.assert_allclose(bilinear(texels, uv * (-1, 1), "mirror"), texels.reshape(-1, 3), atol=1e-6)
    middle = bilinear(texels, np.array([[0.2, 1 - 1 / 4]]))[0]
    np.testing.assert_allclose(middle, texels[:2, :2].mean(axis=(0, 1)), atol=1e-6)
    edge = bilinear(texels, np.array([[7.0, 0.5]]), "clamp")[0]
    np.testing.assert_allclose(edge, texels[1:3, -1].mean(axis=0), atol=1e-6)


@pytest.mark.parametrize("mode", ["L", "LA", "RGB", "RGBA", "P"])
def test_levels_of_a_texture_are_those_of_its_colours_and_opacity(mode: str) -> None:
    texels = np.random.default_rng(7).integers(0, 256, (32, 16, 4)).astype(np.uint8)
    image, file = Image.fromarray(texels).convert(mode), io.BytesIO()
    image.save(file, "PNG")
    levels, expected = Levels(Texture(name="t.png", data=file.getvalue()), 64), image.convert("RGBA")
    assert len(levels) == len(levels.shapes) == 5
    for number in range(5):
        np.testing.assert_array_equal(levels[number], np.asarray(expected))
        assert levels.shapes[number] == (32 >> number, 16 >> number)
        expected = expected.reduce(2)
