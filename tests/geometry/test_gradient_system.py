"""The gradient-domain solves against dense references."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from faces import grid_mesh
from hypothesis import given, settings
from hypothesis import strategies as st
from solvers import SOLVERS

from facepipe.core.errors import InputError
from facepipe.geometry.factor import Solver, factorise
from facepipe.geometry.gradient_system import (
    Bridges,
    GradientSystem,
    cotangent_weights,
    edge_vectors,
    incidence,
    joint_bridges,
    part_bridges,
)
from facepipe.geometry.polygons import components, edges, point_triangles

SIZE = 7
HEAD = SIZE * SIZE
EDGES = edges(grid_mesh(size=SIZE).face_vertex_counts, grid_mesh(size=SIZE).face_vertex_indices)[0]


def grid(solver: Solver = "auto", weights: np.ndarray | None = None) -> GradientSystem:
    nothing = Bridges(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))
    own = np.ones(len(EDGES)) if weights is None else weights
    return GradientSystem(EDGES, own, np.ones(HEAD, dtype=bool), nothing, 3, solver)


def two_parts() -> tuple[np.ndarray, GradientSystem]:
    """A grid with two loose 3 x 3 grids in front of it."""
    loose = [grid_mesh(size=3, offset=z) for z in (0.5, 0.8)]
    points = np.concatenate([grid_mesh(size=SIZE).points, *(one.points + np.array([0.3, 2.0, 0.0]) for one in loose)])
    own = edges(loose[0].face_vertex_counts, loose[0].face_vertex_indices)[0]
    pairs = np.concatenate([EDGES, own + HEAD, own + HEAD + 9])
    component = components(len(points), pairs)
    bridges = part_bridges(points, component, int(component[0]))
    return points, GradientSystem(pairs, np.ones(len(pairs)), component == component[0], bridges, 3)


@SOLVERS
def test_neutral_agrees_with_the_dense_pseudo_inverse(solver: Solver) -> None:
    rng = np.random.default_rng(1)
    wanted, weights = rng.normal(size=(len(EDGES), 3)), rng.uniform(0.1, 3, len(EDGES))
    M = incidence(EDGES, HEAD).toarray()
    dense = np.linalg.pinv(M.T @ np.diag(weights) @ M) @ M.T @ np.diag(weights) @ wanted
    anchor = np.array([1.0, -2.0, 3.0])
    solved = grid(solver, weights).solve(wanted, np.zeros((0, 3)), anchor)
    np.testing.assert_allclose(solved, dense - dense[3] + anchor, atol=1e-9)
    np.testing.assert_array_equal(solved[3], anchor)


@SOLVERS
def test_moving_agrees_with_dense_least_squares(solver: Solver) -> None:
    rng = np.random.default_rng(2)
    wanted = rng.normal(size=(len(EDGES), 3))
    moving = rng.random(HEAD) < 0.5
    moving[3] = False
    touching = moving[EDGES].any(axis=1)
    wanted[~touching] = 0.0
    M = incidence(EDGES, HEAD).toarray()
    L = M.T @ M
    dense = np.linalg.lstsq(L[:, moving], M.T @ wanted, rcond=None)[0]
    held = grid(solver).moving(moving)
    solved = held.solve(wanted[held.edges], np.zeros((0, 3)), np.zeros(3))
    np.testing.assert_array_equal(np.sort(held.points), np.flatnonzero(moving))
    np.testing.assert_allclose(solved[np.argsort(held.points)], dense, atol=1e-9)


def test_parts_and_faces_that_move_altogether_go_as_the_neutral_does() -> None:
    points, system = two_parts()
    random, moving = np.random.default_rng(4), np.ones(len(points), bool)
    vectors = random.normal(size=(len(system.edges), 3))
    across, anchored = random.normal(size=(len(system.bridges.followers), 3)), random.normal(size=3)
    held = system.moving(moving)
    expected = system.solve(vectors, across, anchored)[held.points]
    offsets = held.solve(vectors[held.edges], across[held.bridges], anchored)
    np.testing.assert_allclose(offsets, expected, atol=1e-10)


def test_twice_multiplied_system_has_the_same_solution() -> None:
    """The document's S605' as written changes nothing: M^T D lies in the range of M^T M."""
    wanted = np.random.default_rng(3).normal(size=(len(EDGES), 3))
    M = incidence(EDGES, HEAD).toarray()
    L = M.T @ M
    twice = np.linalg.pinv(L @ L) @ L @ M.T @ wanted
    np.testing.assert_allclose(twice, np.linalg.pinv(L) @ M.T @ wanted, atol=1e-9)


def test_rows_of_ones_can_not_give_points_back() -> None:
    """The document's M with 1 at both ends sums the ends; the signed one gives edge vectors."""
    points = np.random.default_rng(4).normal(size=(HEAD, 3))
    vectors = edge_vectors(points, EDGES)
    M = incidence(EDGES, HEAD)
    np.testing.assert_allclose(M @ points, vectors, atol=1e-12)
    summing = np.abs(M.toarray())
    best = summing @ np.linalg.lstsq(summing, vectors, rcond=None)[0]
    assert np.abs(best - vectors).max() > 0.1


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_differences_of_points_give_them_back_loose_parts_too(seed: int) -> None:
    rng = np.random.default_rng(seed)
    _, system = two_parts()
    count = HEAD + 18
    points = rng.normal(size=(count, 3))
    across = points[system.bridges.followers] - points[system.bridges.leaders]
    solved = system.solve(edge_vectors(points, system.edges), across, points[3])
    np.testing.assert_allclose(solved, points, atol=1e-9)
    moving = rng.random(count) < 0.6
    offsets = np.where(moving[:, None], points, 0.0)
    held = system.moving(moving)
    across = offsets[system.bridges.followers[held.bridges]] - offsets[system.bridges.leaders[held.bridges]]
    found = held.solve(edge_vectors(offsets, system.edges[held.edges]), across, offsets[3])
    given_anchor = held.points != 3
    np.testing.assert_allclose(found[given_anchor], offsets[held.points][given_anchor], atol=1e-8)


def test_loose_parts_never_pull_at_the_face() -> None:
    points, system = two_parts()
    vectors = edge_vectors(points, system.edges)
    across = points[system.bridges.followers] - points[system.bridges.leaders]
    pushed = system.solve(vectors, across + 5.0, points[3])
    np.testing.assert_allclose(pushed[:HEAD], points[:HEAD], atol=1e-9)
    np.testing.assert_allclose(pushed[HEAD:], points[HEAD:] + 5.0, atol=1e-9)


def test_every_loose_point_has_a_bridge_to_its_nearest_point_of_the_face() -> None:
    points, system = two_parts()
    bridges = system.bridges
    np.testing.assert_array_equal(bridges.followers, np.arange(HEAD, HEAD + 18))
    own = np.linalg.norm(points[bridges.followers] - points[bridges.leaders], axis=1)
    every = np.linalg.norm(points[HEAD:, None] - points[None, :HEAD], axis=2)
    np.testing.assert_allclose(own, every.min(axis=1), atol=1e-12)
    assert (bridges.weights > 0).all()


def test_joints_lie_among_their_bridges() -> None:
    rng = np.random.default_rng(5)
    ball = rng.normal(size=(400, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    bridges = joint_bridges(ball, np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.1]]))
    assert (bridges.followers == 0).sum() == 256, "from the centre, all points are near"
    assert np.linalg.norm(ball[bridges.leaders[bridges.followers == 1]] - (0, 0, 1), axis=1).max() < 0.5
    assert len(joint_bridges(ball, np.zeros((0, 3))).weights) == 0


def test_cotangent_weights_are_half_the_cotangents_opposite() -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    pairs, weights = cotangent_weights(points, np.array([[0, 1, 2], [1, 3, 2]]))
    found = {tuple(map(int, pair)): float(weight) for pair, weight in zip(pairs, weights, strict=True)}
    assert found == pytest.approx({(0, 1): 0.5, (0, 2): 0.5, (1, 2): 0.05, (1, 3): 0.5, (2, 3): 0.5})


def test_cotangent_weights_stay_positive_and_finite_on_flat_triangles() -> None:
    mesh = grid_mesh(size=4)
    triangles = point_triangles(mesh.face_vertex_counts, mesh.face_vertex_indices)
    flat = mesh.points * (1.0, 0.0, 0.0)
    _, weights = cotangent_weights(flat, triangles)
    assert np.isfinite(weights).all()
    assert (weights > 0).all()


@SOLVERS
def test_every_solver_agrees_with_a_dense_one(solver: Solver) -> None:
    from scipy.sparse import csr_array, eye_array

    rng = np.random.default_rng(6)
    root = csr_array(np.where(rng.random((60, 60)) < 0.1, rng.normal(size=(60, 60)), 0.0))
    matrix = root @ root.T + eye_array(60)
    right = rng.normal(size=(60, 4))
    expected = np.linalg.solve(matrix.toarray(), right)
    factor = factorise(matrix, solver)
    np.testing.assert_allclose(factor.solve(right), expected, atol=1e-10)
    np.testing.assert_allclose(factor.solve(right[:, 0]), expected[:, 0], atol=1e-10)
    assert factorise(csr_array((0, 0)), solver).solve(np.zeros((0, 3))).shape == (0, 3)


@SOLVERS
def test_a_singular_matrix_is_an_error(solver: Solver) -> None:
    from scipy.sparse import csr_array

    with pytest.raises((RuntimeError, ValueError)):
        factorise(csr_array(np.array([[1.0, -1.0], [-1.0, 1.0]])), solver)


def test_without_cholespy_scipy_solves_unless_cholespy_was_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    from scipy.sparse import csr_array

    monkeypatch.setitem(sys.modules, "cholespy", None)
    matrix = csr_array(np.diag([2.0, 4.0]))
    np.testing.assert_allclose(factorise(matrix).solve(np.ones(2)), [0.5, 0.25])
    with pytest.raises(InputError, match="cholespy is not installed"):
        factorise(matrix, "cholespy")
