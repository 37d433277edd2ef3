"""Distances along surfaces against known ones; seams sewn; heat weights and their restriction."""

from __future__ import annotations

import numpy as np
import pytest
from faces import grid_mesh
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from facepipe.geometry.closest_points import closest_places, place_shares
from facepipe.geometry.geodesics import cells, graph_distances, surface_graph
from facepipe.geometry.heat_weights import fewest, heat_weights, influences
from facepipe.geometry.polygons import edges, point_triangles, welded_points

RNG = np.random.default_rng(3)


def grid(size=31):
    mesh = grid_mesh(size=size)
    return mesh.points, point_triangles(mesh.face_vertex_counts, mesh.face_vertex_indices)


def quad_grid(size=31):
    mesh = grid_mesh(size=size)
    return mesh.points, cells(mesh.face_vertex_counts, mesh.face_vertex_indices)


def test_on_a_plane_they_are_at_most_nine_percent_longer_and_never_shorter():
    points, quads = quad_grid()
    middle = len(points) // 2
    found = graph_distances(surface_graph(points, quads), [np.array([middle])])[0]
    true = np.linalg.norm(points - points[middle], axis=1)
    assert (found >= true * (1 - 1e-9)).all()
    assert (found <= true * 1.09 + 1e-12).all()
    assert (found - true).sum() <= 0.03 * true.sum()


def test_on_triangles_they_are_hardly_longer():
    points, triangles = grid()
    middle = len(points) // 2
    graph = surface_graph(points, np.pad(triangles, ((0, 0), (0, 1)), constant_values=-1))
    found = graph_distances(graph, [np.array([middle])])[0]
    true = np.linalg.norm(points - points[middle], axis=1)
    assert (found >= true * (1 - 1e-9)).all()
    assert (found <= true * 1.09 + 1e-12).all()


def test_quads_have_no_preferred_diagonal():
    points, quads = quad_grid(20)
    turned = quads[:, [1, 2, 3, 0]]
    sources = [np.array([7]), np.array([190])]
    one, other = (graph_distances(surface_graph(points, x), sources) for x in (quads, turned))
    np.testing.assert_allclose(one, other, atol=1e-12)
    mirror = np.arange(400).reshape(20, 20)[:, ::-1].ravel()
    mirrored = graph_distances(surface_graph(points, quads), [mirror[source] for source in sources])[:, mirror]
    np.testing.assert_allclose(mirrored, one, atol=1e-12)


def test_larger_polygons_are_fans():
    counts, indices = np.array([3, 5, 4]), np.array([0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11])
    assert cells(counts, indices).tolist() == [
        [8, 9, 10, 11],
        [0, 1, 2, -1],
        [3, 4, 5, -1],
        [3, 5, 6, -1],
        [3, 6, 7, -1],
    ]


def test_round_a_cylinder_they_are_those_of_the_sheet():
    points, quads = quad_grid()
    bent = np.stack([10 * np.cos(points[:, 0] / 10), points[:, 1], 10 * np.sin(points[:, 0] / 10)], axis=1)
    flat, round_ = (graph_distances(surface_graph(x, quads), [np.array([5])])[0] for x in (points, bent))
    np.testing.assert_allclose(round_, flat, rtol=2e-3)


def test_a_slit_is_gone_round():
    points, quads = quad_grid(21)
    y = points[quads][..., 1]
    x = points[quads][..., 0]
    cut = (y.min(axis=1) == 10) & (np.abs(x).max(axis=1) <= 6)  # a row of quads taken out
    graph = surface_graph(points, quads[~cut])
    below, above = (int(np.flatnonzero((points[:, 0] == 0) & (points[:, 1] == row))[0]) for row in (10, 11))
    assert graph_distances(graph, [np.array([below])])[0, above] > 2 * 5.5


def test_starts_are_added_and_sets_take_the_nearest():
    points, quads = quad_grid(15)
    graph = surface_graph(points, quads)
    ends = np.array([0, len(points) - 1])
    alone = graph_distances(graph, [ends[:1], ends[1:]])
    together = graph_distances(graph, [ends], [np.array([0.0, 2.5])])[0]
    np.testing.assert_allclose(together, np.minimum(alone[0], alone[1] + 2.5), atol=1e-12)


def test_what_nothing_connects_is_infinitely_far():
    points, quads = quad_grid(4)
    two = np.concatenate([points, points + 50.0])
    graph = surface_graph(two, np.concatenate([quads, quads + len(points)]))
    found = graph_distances(graph, [np.array([0])])[0]
    assert np.isfinite(found[: len(points)]).all()
    assert np.isinf(found[len(points) :]).all()


def test_points_on_one_another_are_no_obstacle():
    points, quads = quad_grid(9)
    flat = points.copy()
    flat[quads[20, 0]] = flat[quads[20, 1]]
    found = graph_distances(surface_graph(flat, quads), [np.array([0])])[0]
    assert np.isfinite(found).all()


def test_seams_are_sewn_and_touching_insides_are_not():
    mesh = grid_mesh(size=5)
    points = np.concatenate([mesh.points, mesh.points + np.array([4.0, 0, 0])])  # side by side
    pairs, faces = edges(mesh.face_vertex_counts, mesh.face_vertex_indices)
    border = np.zeros(len(mesh.points), bool)
    border[pairs[faces == 1].ravel()] = True
    assert len(np.unique(welded_points(points, np.tile(border, 2), 1e-6))) == 45
    on_top = np.concatenate([mesh.points, mesh.points])
    assert len(np.unique(welded_points(on_top, np.tile(border, 2), 1e-6))) == 50 - border.sum()


def test_heat_weights_obey_the_maximum_principle_and_sum_to_one():
    points, triangles = grid()
    bumpy = points + RNG.normal(scale=0.3, size=points.shape)  # obtuse triangles too
    shares = np.eye(5)[RNG.integers(0, 5, len(points))]
    found = heat_weights(bumpy, triangles, shares, RNG.uniform(0.01, 30, len(points)))
    assert found.min() >= 0
    assert found.max() <= 1 + 1e-9
    np.testing.assert_allclose(found.sum(axis=1), 1, atol=1e-9)


def test_heat_weights_of_no_shape_at_all_keep_the_shares():
    points, triangles = grid(5)
    more = np.concatenate([points, [[9.0, 9, 9]]])  # a point without triangle
    shares = np.tile([0.25, 0.75], (len(more), 1))
    np.testing.assert_allclose(heat_weights(more, triangles, shares, np.ones(len(more))), shares, atol=1e-12)


@given(arrays(float, (12, 7), elements=st.floats(0, 1)), st.integers(1, 9))
def test_few_influences_are_the_largest_in_sum_one(weights, count):
    kept = fewest(weights, count)
    assert ((kept > 0).sum(axis=1) <= count).all()
    some = weights.sum(axis=1) > 1e-12
    np.testing.assert_allclose(kept.sum(axis=1)[some], 1)
    for row, whole in zip(kept[some], weights[some], strict=True):
        assert whole[row > 0].min() >= np.sort(whole)[::-1][:count][-1] - 1e-15
    indices, values = influences(kept, count)
    assert (indices[values == 0] == 0).all()
    assert values[some].sum(axis=1) == pytest.approx(1, abs=1e-6)


def test_few_influences_change_places_without_a_jump():
    t = np.linspace(0, 1, 400)[:, None]
    weights = np.concatenate([0.5 + 0 * t, 0.3 * t, 0.3 * (1 - t), 0.2 - 0 * t, 0.1 * t], axis=1)
    weights /= weights.sum(axis=1, keepdims=True)
    assert np.abs(np.diff(fewest(weights, 2), axis=0)).max() < 0.02


def test_places_are_the_mix_of_their_corners():
    points, triangles = grid(6)
    bumpy = points + RNG.normal(scale=0.2, size=points.shape)
    at = np.concatenate([RNG.uniform(-4, 9, (200, 3)), bumpy, bumpy[triangles[:, :2]].mean(axis=1)])
    found = closest_places(at, bumpy, triangles)
    shares = place_shares(found, bumpy, triangles)
    assert shares.min() >= 0
    np.testing.assert_allclose(shares.sum(axis=1), 1)
    np.testing.assert_allclose(
        np.einsum("mc,mci->mi", shares, bumpy[triangles[found.triangles]]), found.places, atol=1e-9
    )
