"""Local refinement: changes of triangles, and faces drawn onto scans where they may follow."""

from __future__ import annotations

import numpy as np
import pytest
from scan_domes import POSE, dome, grid
from scipy.sparse import csr_array
from scipy.spatial.transform import Rotation

from facepipe.core.errors import FitError
from facepipe.geometry.change_smoothness import BlockSystem, ChangeSmoothness, Groups, pairs_within
from facepipe.geometry.deformation_transfer import Neighbours, TriangleChanges
from facepipe.geometry.factor import factorise
from facepipe.geometry.local_refinement import RefinementOptions, refine_locally
from facepipe.geometry.polygons import point_normals
from facepipe.geometry.registration import Anchors, DeformableSurface, Registered, ScanTarget, View
from facepipe.geometry.similarity import Similarity

AT_HOME = Similarity(rotation=np.eye(3), translation=np.zeros(3))
_NO_ANCHORS = Anchors.at_points(np.zeros(1, np.int64), np.full((1, 3), np.nan))
_ABOUT_RIGHT = RefinementOptions(detail_mm=6.0, drift_mm=2.0)
_UP = np.array([0.0, 0.0, 1.0])
_TURN = Rotation.from_rotvec([0.4, -0.7, 0.2]).as_matrix()


def _dome(side: int = 21) -> tuple[np.ndarray, np.ndarray]:
    places, triangles = grid(side)
    return dome(places, 0), triangles


def _bumped(side: int, height: float = 2.0) -> np.ndarray:
    """The dome with what no dome has: a bump along its normals, within 12 mm of (-18, 8)."""
    points, triangles = _dome(side)
    away = np.linalg.norm(points[:, :2] - (-18.0, 8.0), axis=1)
    up = height * np.maximum(1.0 - (away / 12.0) ** 2, 0.0) ** 2
    return np.asarray(points + up[:, None] * point_normals(points, triangles))


def _region(points: np.ndarray) -> np.ndarray:
    """1 around the bump, 0 beyond 20 mm, soft between."""
    away = np.linalg.norm(points[:, :2] - (-18.0, 8.0), axis=1)
    return np.clip((20.0 - away) / 4.0, 0.0, 1.0)


def _surface(points: np.ndarray, triangles: np.ndarray) -> DeformableSurface:
    count = len(points)
    return DeformableSurface(
        base=points,
        modes=np.zeros((0, count, 3)),
        expected=np.zeros(0),
        precision=np.zeros(0),
        triangles=triangles,
        seen=np.arange(count),
        held=np.zeros(count),
    )


def test_the_change_of_a_surface_that_is_turned_and_scaled_as_a_whole_is_that() -> None:
    points, triangles = _dome()
    changes = TriangleChanges.from_rest(points, triangles).at(1.3 * points @ _TURN.T + [5.0, 6.0, 7.0])
    assert np.allclose(changes, 1.3 * _TURN, atol=1e-12)


def test_an_affine_map_changes_the_edges_of_all_triangles_alike() -> None:
    points, triangles = _dome()
    affine = np.array([[1.1, 0.2, 0.0], [0.0, 0.9, -0.1], [0.3, 0.0, 1.0]])
    edges = (points[triangles[:, 1:]] - points[triangles[:, :1]]).transpose(0, 2, 1)
    changes = TriangleChanges.from_rest(points, triangles).at(points @ affine.T + [1.0, 2.0, 3.0])
    assert np.allclose(changes @ edges, affine @ edges, atol=1e-11)


def test_derivatives_are_those_of_small_moves() -> None:
    points, triangles = _dome(6)
    rng = np.random.default_rng(2)
    changes = TriangleChanges.from_rest(points, triangles)
    now, move = points + rng.normal(size=points.shape), 1e-5 * rng.normal(size=points.shape)
    slopes = np.einsum("tij,tj->ti", changes.derivative(now), move[triangles].reshape(-1, 9))
    expected = (changes.at(now + move) - changes.at(now - move)).reshape(-1, 9) / 2.0
    assert np.allclose(slopes, expected, atol=1e-12)
    neighbours = Neighbours.across_edges(points, triangles, changes.areas)
    between = np.einsum(
        "pij,pj->pi", neighbours.derivative(changes.derivative(now)), move[neighbours.points].reshape(-1, 12)
    )
    assert np.allclose(between, neighbours.differences(slopes.reshape(-1, 3, 3)), atol=1e-12)


def test_every_inner_edge_has_a_pair_of_neighbours() -> None:
    points, triangles = _dome(6)
    neighbours = Neighbours.across_edges(points, triangles, TriangleChanges.from_rest(points, triangles).areas)
    own, other = triangles[neighbours.pairs[:, 0]], triangles[neighbours.pairs[:, 1]]
    shared = [frozenset(a) & frozenset(b) for a, b in zip(own.tolist(), other.tolist(), strict=True)]
    assert {len(edge) for edge in shared} == {2}
    assert len(set(shared)) == len(shared) == 2 * 4 * 5 + 25
    assert np.array_equal(np.take_along_axis(neighbours.points, neighbours.second, axis=1), other)


def test_finer_triangles_make_the_same_smoothness() -> None:
    found = []
    for side in (31, 61):
        points, triangles = _dome(side)
        changes = TriangleChanges.from_rest(points, triangles)
        neighbours = Neighbours.across_edges(points, triangles, changes.areas)
        waves = points + np.sin(points / 9.0) @ _TURN
        found.append((neighbours.weights[:, None] * neighbours.differences(changes.at(waves)) ** 2).sum())
    assert np.isclose(*found, rtol=0.05)


def test_a_system_of_groups_is_that_of_all_their_rows() -> None:
    rng = np.random.default_rng(3)
    members = np.array([[0, 1, 2], [3, 1, -1], [2, 0, 3], [4, 3, 0]])
    jacobian, residual, weights = rng.normal(size=(4, 10, 9)), rng.normal(size=(4, 10)), rng.uniform(1, 2, 4)
    low, high = np.sort(pairs_within(members), axis=1).T
    links = np.unique(5 * low + high)
    system = BlockSystem(5, links)
    system.add(Groups.among(members, 5, links), jacobian, residual, weights)
    rows = np.zeros((4, 10, 6, 3))
    for group, points in enumerate(members):
        for member, point in enumerate(points):
            rows[group, :, point] = jacobian[group, :, 3 * member : 3 * member + 3]
    flat = rows[:, :, :5].reshape(40, 15)
    matrix = flat.T @ (np.repeat(weights, 10)[:, None] * flat)
    expected = np.linalg.solve(matrix, -flat.T @ (np.repeat(weights, 10) * residual.ravel()))
    solved = factorise(system.matrix(csr_array((5, 5)))).solve(system.right.ravel())
    assert np.allclose(solved, expected)


def test_what_moves_by_smoothness_alone_goes_on_as_around_it() -> None:
    """The middle of a dome that is turned and scaled at its rim follows, to the bit that a first order leaves."""
    points, triangles = _dome()
    free = (np.abs(points[:, :2]) < 30.0).all(axis=1)
    moved = 1.05 * points @ Rotation.from_rotvec([0.0, 0.1, 0.05]).as_matrix().T
    smoothness = ChangeSmoothness.at_rest(points, triangles, free, 1.0, 0.0)
    found = np.where(free[:, None], points, moved)
    for _ in range(6):
        system = smoothness.system(found)
        step = factorise(system.matrix(csr_array((free.sum(), free.sum())))).solve(system.right.ravel())
        found[free] += step.reshape(-1, 3)
    assert np.allclose(found, moved, atol=1e-7)


def _refined(follow: np.ndarray | None = None, pose: Similarity = AT_HOME, side: int = 21) -> Registered:
    """A dome refined on the scan of one with a bump."""
    (points, triangles), (_, fine) = _dome(side), _dome(81)
    target = ScanTarget.of_surface(pose.apply(_bumped(81)), fine)
    place = Similarity(rotation=pose.rotation.T, translation=pose.undo(np.zeros((1, 3)))[0], scale=1.0 / pose.scale)
    view = View(scan=target, anchors=_NO_ANCHORS, start=place)
    all_of_it = np.ones(len(points)) if follow is None else follow
    return refine_locally(_surface(points, triangles), view, all_of_it, _ABOUT_RIGHT)


@pytest.mark.parametrize("side", [21, 41])
def test_a_bump_that_the_face_lacks_is_drawn_onto_it(side: int) -> None:
    points, truth = _dome(side)[0], _bumped(side)
    found = _refined(side=side)
    before, after = (np.linalg.norm(one - truth, axis=1) for one in (points, found.points))
    bump = before > 0.0
    assert before[bump].mean() > 0.6
    assert after[bump].mean() < 0.12
    assert after[~bump].mean() < 0.03
    assert np.nanmean(found.distances) < 0.005


def test_points_outside_the_region_stay_to_the_bit_and_the_border_has_no_crease() -> None:
    points, triangles = _dome(41)
    truth, region = _bumped(41), _region(points)
    found = _refined(region, side=41)
    assert found.points[region == 0].tobytes() == points[region == 0].tobytes()
    assert not found.matched[region == 0].any()
    assert (
        np.linalg.norm(found.points - truth, axis=1)[region > 0].mean()
        < 0.25 * np.linalg.norm(points - truth, axis=1)[region > 0].mean()
    )
    changes = TriangleChanges.from_rest(points, triangles)
    neighbours = Neighbours.across_edges(points, triangles, changes.areas)
    bends = np.linalg.norm(neighbours.differences(changes.at(found.points)), axis=1)
    true_bends = np.linalg.norm(neighbours.differences(changes.at(truth)), axis=1)
    assert bends.max() < 1.3 * true_bends.max()


def test_points_without_triangles_and_triangles_without_area_are_no_trouble() -> None:
    points, triangles = _dome()
    more = np.concatenate([points, points[:1], [[-18.0, 8.0, 500.0]]])
    flat = np.array([[0, 0, 1], [0, len(points), 1]])  # a point twice, and two points at one place
    surface = _surface(more, np.concatenate([triangles, flat]))
    target = ScanTarget.of_surface(_bumped(81), _dome(81)[1])
    view = View(scan=target, anchors=_NO_ANCHORS, start=AT_HOME)
    found = refine_locally(surface, view, np.ones(len(more)), _ABOUT_RIGHT).points
    assert np.allclose(found[-1], more[-1], atol=1e-9)
    assert np.linalg.norm(found[: len(points)] - _bumped(21), axis=1).max() < 0.4


def test_where_the_scan_lies_changes_nothing() -> None:
    assert np.abs(_refined(pose=POSE).points - _refined().points).max() < 1e-6


@pytest.mark.parametrize(("share", "size"), [(0.25, 1.0), (0.5, 1.0), (1.0, 1.0), (0.25, 0.01)])
def test_a_point_that_follows_in_part_goes_that_share_of_the_way(share: float, size: float) -> None:
    places, triangles = grid(21)
    flat = size * np.c_[places, np.zeros(len(places))]
    scan, fine = _plane(0.2)
    target = ScanTarget.of_surface(scan * [size, size, 1.0], fine)
    view = View(scan=target, anchors=_NO_ANCHORS, start=AT_HOME)
    found = refine_locally(_surface(flat, triangles), view, np.full(len(flat), share))
    assert np.allclose(found.points, flat + 0.2 * share * _UP, atol=0.01)


def test_half_of_a_wave_as_long_as_the_detail_is_followed() -> None:
    places, triangles = grid(61)
    flat = np.c_[places, np.zeros(len(places))]
    scan, fine = _plane(0.0)
    inner = np.abs(places).max(axis=1) < 30.0
    for detail, share in ((20.0, 0.5), (40.0, 1.0 / 17.0), (10.0, 16.0 / 17.0)):
        wave = scan + 0.1 * np.cos(2.0 * np.pi * scan[:, :1] / 20.0) * _UP
        options = RefinementOptions(detail_mm=detail, fade_mm=300.0)
        view = View(scan=ScanTarget.of_surface(wave, fine), anchors=_NO_ANCHORS, start=AT_HOME)
        height = refine_locally(_surface(flat, triangles), view, np.ones(len(flat)), options).points[inner, 2]
        along = np.cos(2.0 * np.pi * places[inner, 0] / 20.0)
        assert np.isclose((height @ along) / (along @ along), 0.1 * share, atol=0.008)


def test_landmarks_draw_the_face_along_the_surface() -> None:
    places, triangles = grid(21)
    flat = np.c_[places, np.zeros(len(places))]
    middle = np.array([20 * 11])
    anchors = Anchors.at_points(middle, flat[middle] + [1.0, 0.0, 0.0])
    view = View(scan=ScanTarget.of_surface(*_plane(0.0)), anchors=anchors, start=AT_HOME)
    moved = refine_locally(_surface(flat, triangles), view, np.ones(len(flat))).points - flat
    assert moved[middle, 0] > 0.7
    assert np.abs(moved[:, 2]).max() < 1e-6
    elsewhere = np.where(np.linalg.norm(places - places[middle], axis=1) < 20.0, 0.0, 1.0)
    assert np.abs(refine_locally(_surface(flat, triangles), view, elsewhere).points - flat).max() < 1e-6


def test_a_scan_of_something_else_is_refused() -> None:
    points, triangles = _dome()
    far = ScanTarget.of_surface(points + 500.0 * _UP, triangles)
    with pytest.raises(FitError, match=r"scan: 0 points of the face find a place on it, expected 50 or more"):
        refine_locally(
            _surface(points, triangles), View(scan=far, anchors=_NO_ANCHORS, start=AT_HOME), np.ones(len(points))
        )


def _plane(height: float) -> tuple[np.ndarray, np.ndarray]:
    """A larger one than the grids."""
    places, triangles = grid(47)
    return np.c_[1.3 * places, np.full(len(places), height)], triangles
