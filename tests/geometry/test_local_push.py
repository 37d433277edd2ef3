"""The least push of a surface: against a dense quadratic program, and triangles that it turns back."""

from __future__ import annotations

import numpy as np
from scipy.optimize import nnls

from facepipe.geometry.gradient_system import Bridges, GradientSystem
from facepipe.geometry.local_push import Demands, least_push
from facepipe.geometry.polygons import triangle_normals
from facepipe.verbs.blend.folds import Folds


def sheet(side: int = 15) -> tuple[np.ndarray, np.ndarray, GradientSystem]:
    """A square of points one apart, its triangles, and the system of its edges."""
    x, y = np.meshgrid(np.arange(side), np.arange(side))
    points = np.stack([x.ravel(), y.ravel(), np.zeros(side * side)], axis=1).astype(np.float64)
    corner = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    triangles = np.concatenate(
        [
            np.stack([corner, corner + 1, corner + side], axis=1),
            np.stack([corner + 1, corner + side + 1, corner + side], axis=1),
        ]
    )
    edges = np.unique(np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    nothing = Bridges(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))
    main = np.ones(len(points), bool)
    return points, triangles, GradientSystem(edges, np.ones(len(edges)), main, nothing, 0)


def demands(points: list[int], ways: np.ndarray, needs: list[float]) -> Demands:
    return Demands(np.array(points, np.int64)[:, None], np.asarray(ways, np.float64)[:, None], np.array(needs))


def test_a_push_is_the_least_in_the_bi_laplacian() -> None:
    """The dual is solved by another program, from the dense matrix."""
    points, _, system = sheet()
    free = np.ones(len(points), bool)
    free[0] = False
    asked, ways, needs = [112, 113, 97, 130], np.eye(3)[[2, 2, 2, 0]], [1.0, 0.4, -2.0, 0.3]
    pushed = least_push(system, points, free, demands(asked, ways, needs), 4.5)
    near = np.linalg.norm(points[:, None] - points[asked], axis=2).min(axis=1) <= 4.5
    near[0] = False
    laplacian = np.zeros((len(points), len(points)))
    for a, b in system.edges:
        laplacian[[a, b], [a, b]] += 1.0
        laplacian[[a, b], [b, a]] -= 1.0
    dense = np.linalg.inv((laplacian @ laplacian)[np.ix_(near, near)])
    rows = np.searchsorted(np.flatnonzero(near), asked)
    matrix = dense[np.ix_(rows, rows)] * (ways @ ways.T)
    root = np.linalg.cholesky(matrix)
    forces = nnls(root.T, np.linalg.solve(root, needs))[0]
    expected = np.zeros(points.shape)
    expected[near] = dense[:, rows] @ (forces[:, None] * ways)
    np.testing.assert_allclose(pushed, expected, atol=5e-3)  # demands are soft by a thousandth
    assert not pushed[~near].any()
    assert pushed[112, 2] > 0.99
    assert pushed[113, 2] >= 0.4 - 0.01


def test_demands_on_points_that_are_held_are_left_out() -> None:
    points, _, system = sheet()
    free = np.zeros(len(points), bool)
    assert not least_push(system, points, free, demands([112], np.eye(3)[[2]], [1.0]), 4.0).any()
    assert not least_push(system, points, ~free, demands([], np.zeros((0, 3)), []), 4.0).any()
    assert not least_push(system, points, ~free, demands([112], np.zeros((1, 3)), [1.0]), 4.0).any()


def test_of_more_demands_than_can_be_solved_at_once_the_largest_are_met() -> None:
    points, _, system = sheet(25)
    free = np.ones(len(points), bool)
    free[0] = False
    many = list(range(1, len(points)))
    needs = np.where(np.isin(many, [100, 200, 300]), 1.0, 0.01 * points[many, 0] / 25)
    pushed = least_push(system, points, free, demands(many, np.tile([0.0, 0.0, 1.0], (len(many), 1)), needs), 3.0)
    assert (pushed[[100, 200, 300], 2] > 0.9).all()


def test_a_triangle_that_is_turned_over_turns_back() -> None:
    """A point of a sheet goes across the edge opposite; in neither source does it."""
    points, triangles, system = sheet()
    pose = points.copy()
    pose[112] += (1.4, 0.0, 0.0)
    folds = Folds(pose, [points, points + np.array([0.0, 0.0, 3.0])], triangles)
    folds.look()
    flat = triangle_normals(pose, triangles)[:, 2]
    np.testing.assert_array_equal(folds.turned, np.flatnonzero(flat < 0))
    assert len(folds.turned) >= 2
    free = np.ones(len(points), bool)
    free[0] = False
    for _ in range(3):
        pose += least_push(system, pose, free, folds.demands(), 4.0)
        folds.look()
    assert (triangle_normals(pose, triangles)[:, 2] > 0).all()
    assert not len(folds.turned)


def test_a_fold_of_a_source_may_stay() -> None:
    points, triangles, _ = sheet()
    pose = points.copy()
    pose[112] += (1.4, 0.0, 0.0)
    folds = Folds(pose, [points, pose], triangles)
    folds.look()
    assert not len(folds.turned)
    assert folds.cost == 0.0


def test_what_turns_back_turns_nothing_else_over() -> None:
    """Sheets crumpled at random, 30 triangles of each turned over; with demands of these alone 8 stay so in all."""
    left = 0
    for seed in range(12):
        points, triangles, system = sheet()
        away = points[:, :2] - 7.0
        inner = (np.abs(away) < 4).all(axis=1)
        pose = points.copy()
        pose[inner] += 0.8 * np.random.default_rng(seed).standard_normal((int(inner.sum()), 3))
        wavy = points + np.outer(np.cos(away[:, 0]), [0.0, 0.0, 0.5])
        folds = Folds(pose, [points, wavy], triangles)
        folds.look()
        free = np.ones(len(points), bool)
        free[0] = False
        for _ in range(12):
            cost, pushes = folds.cost, least_push(system, pose, free, folds.demands(), 4.0)
            for share in (1.0, -0.5, -0.25, -0.25):
                pose += share * pushes
                folds.look()
                if folds.cost < cost:
                    break
        left += len(folds.turned)
    assert left <= 3
