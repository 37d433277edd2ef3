"""Mended scan surfaces, on shapes whose right answer is known."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scan_files import volume
from solids import ball

from facepipe.core.errors import InputError
from facepipe.geometry.polygons import border_points, point_normals
from facepipe.geometry.scan_surface import CleanSurface, clean_surface, cloud_normals, outward_triangles

Array = np.ndarray[Any, Any]
BOX = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float64)
SIDES = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
BOX_TRIANGLES = np.array([[a, *two] for a, b, c, d in SIDES for two in ((b, c), (c, d))])


def joined(*shapes: tuple[Array, Array]) -> tuple[Array, Array]:
    starts = np.cumsum([0, *(len(points) for points, _ in shapes)])
    points = np.concatenate([points for points, _ in shapes])
    return points, np.concatenate([one[1] + start for one, start in zip(shapes, starts, strict=False)])


def sound(surface: CleanSurface) -> None:
    """Each directed edge once at most: a manifold of one orientation; the border is where its opposite is missing."""
    triangles = surface.triangles
    directed = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    edges = set(map(tuple, directed.tolist()))
    assert len(edges) == len(directed)
    border = {point for a, b in edges if (b, a) not in edges for point in (a, b)}
    assert set(np.flatnonzero(surface.border).tolist()) == border
    assert set(np.unique(triangles)) == set(range(len(surface.points)))


def band(twists: int, around: int = 40, across: int = 4) -> tuple[Array, Array]:
    """A closed band of triangles that turns `twists` half turns on its way round; one is Moebius's."""
    turn = 2 * np.pi * np.arange(around) / around
    offset = np.linspace(-0.3, 0.3, across)
    half = twists * turn / 2
    radius = 1 + offset * np.cos(half)[:, None]
    points = np.stack(
        [radius * np.cos(turn)[:, None], radius * np.sin(turn)[:, None], offset * np.sin(half)[:, None]], 2
    )
    triangles = []
    for i in range(around):
        for j in range(across - 1):
            here, beyond = i * across, (i + 1) * across
            a, b, c, d = here + j, here + j + 1, beyond + j + 1, beyond + j
            if i == around - 1:
                c, d = (across - 2 - j, across - 1 - j) if twists % 2 else (j + 1, j)
            triangles += [(a, b, c), (a, c, d)]
    return points.reshape(-1, 3), np.array(triangles)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6), inside_out=st.booleans(), rows=st.integers(3, 9))
def test_turned_triangles_are_turned_back(seed: int, inside_out: bool, rows: int) -> None:
    rng = np.random.default_rng(seed)
    points, triangles = ball(rows)
    mixed = np.where(rng.random((len(triangles), 1)) < (0.7 if inside_out else 0.3), triangles[:, ::-1], triangles)
    order = rng.permutation(len(points))
    shuffled, back = points[order], np.argsort(order)
    surface = clean_surface(shuffled, back[mixed][rng.permutation(len(mixed))])
    sound(surface)
    assert volume(surface.points, surface.triangles) == pytest.approx(volume(points, triangles))
    assert (surface.points == shuffled[surface.source]).all()
    assert surface.report.border_points == surface.report.split_points == 0


def test_a_sound_surface_stays_as_it_is() -> None:
    points, triangles = ball(12)
    surface = clean_surface(points, triangles)
    assert (surface.points == points).all()
    assert (np.sort(surface.triangles, axis=1) == np.sort(triangles, axis=1)).all()
    changed = {name: value for name, value in vars(surface.report).items() if value}
    assert changed == {"components": 1}


def test_torn_seams_and_flat_triangles_are_mended() -> None:
    """A ball of loose triangles, with triangles without area and repeated ones among them, is a ball again."""
    points, triangles = ball(10)
    loose = points[triangles].reshape(-1, 3)
    own = np.arange(len(loose)).reshape(-1, 3)
    thin = np.array([[0, 0, 1], [2, 5, 5]])
    surface = clean_surface(np.concatenate([loose, [[9.0, 9.0, 9.0]]]), np.concatenate([own, thin, own[:3, ::-1]]))
    sound(surface)
    assert len(surface.points) == len(points)
    assert not surface.border.any()
    report = surface.report
    assert (report.merged_points, report.flat_triangles, report.repeated_triangles) == (len(loose) - len(points), 2, 3)
    assert report.unused_points == 1


def test_small_pieces_go_and_large_ones_are_ordered() -> None:
    big, middle, junk = ball(16, 10.0), ball(8, 3.0), ball(4, 0.5)
    shapes = [(junk[0] + 30, junk[1]), (middle[0] + 20, middle[1][:, ::-1]), big]
    surface = clean_surface(*joined(*shapes))
    sound(surface)
    assert (surface.report.components, surface.report.small_components) == (2, 1)
    assert surface.report.small_triangles == len(junk[1])
    assert set(surface.component[np.linalg.norm(surface.points, axis=1) < 11]) == {0}
    assert volume(surface.points, surface.triangles) == pytest.approx(volume(*big) + volume(*middle))


def test_a_fin_goes_without_a_trace() -> None:
    points, triangles = ball(12)
    a, b = triangles[40][:2]
    fin = [[a, b, len(points)]]
    surface = clean_surface(np.concatenate([points, [points[a] * 1.05]]), np.concatenate([triangles, fin]))
    sound(surface)
    assert len(surface.triangles) == len(triangles)
    assert not surface.border.any()
    assert surface.report.small_components == 1


@pytest.mark.parametrize("shared", [[0, 1], [0]])
def test_boxes_that_touch_come_apart(shared: list[int]) -> None:
    """At an edge (four triangles there) or a corner: each box has its own copy of it, and both stay closed."""
    other = -BOX
    number = np.arange(8) + 8
    for point in shared:
        other[point] = BOX[point]
        number[point] = point
    if len(shared) == 2:
        other = BOX * [-1, -1, 1]
    surface = clean_surface(np.concatenate([BOX, other]), np.concatenate([BOX_TRIANGLES, number[BOX_TRIANGLES]]))
    sound(surface)
    assert surface.report.components == 2
    assert len(surface.points) == 16
    assert surface.report.split_points == len(shared)
    assert not surface.border.any()
    assert volume(surface.points, surface.triangles) == pytest.approx(2.0)


@pytest.mark.parametrize("twists", [0, 1, 2, 3])
def test_one_sided_bands_are_cut_and_others_are_not(twists: int) -> None:
    points, triangles = band(twists)
    surface = clean_surface(points, triangles)
    sound(surface)
    assert len(surface.triangles) == len(triangles)
    assert (surface.report.one_sided_edges > 0) == bool(twists % 2)
    assert surface.report.components == 1


def test_a_closed_one_sided_surface_is_cut_too() -> None:
    """Klein's bottle as a grid: its points lie anywhere, in 3 dimensions it runs through itself."""
    size = 9
    grid = np.arange(size * size).reshape(size, size)
    right = np.roll(grid, -1, axis=1)
    down = np.concatenate([grid[1:], grid[:1, (-np.arange(size)) % size]])
    corner = np.roll(down, -1, axis=1)
    quads = [one.ravel() for one in (grid, right, corner, down)]
    triangles = np.concatenate(
        [np.stack([quads[0], quads[1], quads[2]], 1), np.stack([quads[0], quads[2], quads[3]], 1)]
    )
    points = np.random.default_rng(0).normal(size=(size * size, 3))
    surface = clean_surface(points, triangles)
    sound(surface)
    assert len(surface.triangles) == len(triangles)
    assert surface.report.one_sided_edges > 0


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10**6), count=st.integers(1, 60))
def test_any_soup_becomes_sound(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    points, triangles = rng.normal(size=(12, 3)), rng.integers(0, 12, (count, 3))
    try:
        surface = clean_surface(points, triangles, smallest=0.0)
    except InputError:
        assert all(len(set(row)) < 3 for row in triangles.tolist())
        return
    sound(surface)
    different = {frozenset(row) for row in triangles.tolist() if len(set(row)) == 3}
    assert len(surface.triangles) == len(different)  # nothing is lost, only cut
    assert {frozenset(row) for row in surface.source[surface.triangles].tolist()} == different


def test_open_faces_bulge_outward_and_their_border_is_flagged() -> None:
    points, triangles = ball(24)
    cap = triangles[(points[triangles][:, :, 2] > 0.3).all(axis=1)]
    for faces in (cap, cap[:, ::-1]):
        surface = clean_surface(points, faces)
        sound(surface)
        a, b, c = surface.points[surface.triangles].transpose(1, 0, 2)
        assert (np.einsum("tc,tc->t", np.cross(b - a, c - a), a) > 0).all()
        assert np.abs(surface.points[surface.border][:, 2] - surface.points[:, 2].min()).max() < 1e-9


def test_flat_surfaces_keep_the_side_that_most_had() -> None:
    grid = np.stack(np.meshgrid(np.arange(6.0), np.arange(6.0)), 2).reshape(-1, 2)
    points = np.c_[grid, np.zeros(36)]
    quads = np.array([[i, i + 1, i + 7, i + 6] for i in range(29) if i % 6 < 5])
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    mixed = triangles.copy()
    mixed[::4] = mixed[::4, ::-1]
    for faces, side in ((mixed, 1.0), (mixed[:, ::-1], -1.0)):
        a, b, c = points[(surface := clean_surface(points, faces)).source][surface.triangles].transpose(1, 0, 2)
        assert (np.sign(np.cross(b - a, c - a)[:, 2]) == side).all()


def test_nothing_but_flat_triangles_is_refused() -> None:
    with pytest.raises(InputError, match="no triangle with an area"):
        clean_surface(np.zeros((4, 3)), np.array([[0, 1, 2], [1, 2, 3]]))


@pytest.mark.parametrize("noise", [0.0, 0.003])
def test_normals_of_clouds_are_those_of_the_ball(noise: float) -> None:
    rng = np.random.default_rng(3)
    directions = rng.normal(size=(4000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    points = directions * (50 * (1 + noise * rng.standard_normal((4000, 1)))) + [200.0, -30.0, 7.0]
    found = cloud_normals(points)
    cosine = np.einsum("ni,ni->n", found.normals, directions)
    assert (cosine > 0).all()
    assert np.degrees(np.arccos(cosine.clip(-1, 1))).mean() < (2.0 if noise == 0 else 6.0)
    assert not found.lone.any()


def test_each_piece_of_a_cloud_faces_outward_and_lone_points_are_reported() -> None:
    big, small = ball(20)[0], ball(12)[0] * 0.5 + 9.0
    found = cloud_normals(np.concatenate([big, small, [[30.0, 0.0, 0.0]]]))
    outward = np.concatenate([big, small - 9.0])
    assert (np.einsum("ni,ni->n", found.normals[:-1], outward) > 0).all()
    assert found.lone.tolist() == [False] * len(outward) + [True]


def test_signs_run_around_folds() -> None:
    """A ball dented past its middle: seen from there, outward is inward in the dent."""
    from scipy.spatial import ConvexHull

    height = 1 - 2 * (np.arange(20000) + 0.5) / 20000  # Fibonacci's sphere: points evenly all over
    turn = np.pi * (1 + 5**0.5) * np.arange(20000)
    points = np.c_[np.sqrt(1 - height**2)[:, None] * np.c_[np.cos(turn), np.sin(turn)], height]
    triangles = clean_surface(points, ConvexHull(points).simplices).triangles
    points[:, 2] -= np.where(height > 0, 1.5 * np.exp(-(1 - height**2) / 0.2), 0.0)
    truth = point_normals(points, triangles)
    assert (np.einsum("ni,ni->n", truth, points - points.mean(axis=0)) < 0).mean() > 0.05
    assert (np.einsum("ni,ni->n", cloud_normals(points).normals, truth) > 0).all()


@pytest.mark.parametrize("share", [0.0, 0.4, 0.7, 1.0])
def test_triangles_face_outward_however_a_file_has_turned_them(share: float) -> None:
    points, triangles = ball(2)
    rng = np.random.default_rng(3)
    wrong = rng.permutation(len(triangles)) < share * len(triangles)
    mixed = np.where(wrong[:, None], triangles[:, ::-1], triangles)
    found, turned = outward_triangles(points, mixed)
    a, b, c = points[found].transpose(1, 0, 2)
    assert (np.einsum("tc,tc->t", np.cross(b - a, c - a), a + b + c) > 0).all()
    assert np.array_equal(np.sort(found, axis=1), np.sort(mixed, axis=1))
    assert np.array_equal(turned, wrong)


def test_of_triangles_that_are_there_for_both_sides_one_stays() -> None:
    points, triangles = ball(2)
    flat = np.append(triangles[0, :2], len(points))
    more = np.concatenate([points, points[flat[:1]]])
    both = np.concatenate([triangles, triangles[::3, ::-1], triangles[::5], flat[None]])
    found, turned = outward_triangles(more, both)
    assert np.array_equal(found[:-1], triangles)
    assert not turned.any()


@pytest.mark.parametrize("share", [0.0, 0.2, 0.9])
def test_border_points_are_on_edges_that_no_other_triangle_runs_back_along(share: float) -> None:
    points, triangles = ball(8)
    kept = triangles[np.random.default_rng(5).random(len(triangles)) >= share]
    runs = {(int(row[i]), int(row[(i + 1) % 3])) for row in kept for i in range(3)}
    expected = {end for start, end in runs if (end, start) not in runs}
    assert set(border_points(len(points), kept).tolist()) == expected
