"""Shares of sources by least squares: optimal, exact, and equal where the problem leaves them open."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from facepipe.geometry.bounded_least_squares import SimplexFit, fit_simplex

ProblemArrays = tuple[np.ndarray, np.ndarray, int, int]


@st.composite
def problems(draw: st.DrawFn, largest: int = 6) -> ProblemArrays:
    """G, g, R, K of any rank, with repeated and absent columns and any scale."""
    groups, sources = draw(st.integers(1, largest)), draw(st.integers(1, largest))
    rng = np.random.default_rng(draw(st.integers(0, 2**31)))
    rows = draw(st.integers(1, 3 * groups * sources))
    basis = rng.normal(size=(rows, groups * sources)) + draw(st.sampled_from([0.0, 3.0])) * rng.normal(size=(rows, 1))
    for _ in range(draw(st.integers(0, 3))):
        basis[:, rng.integers(basis.shape[1])] = basis[:, rng.integers(basis.shape[1])]
    basis[:, rng.random(basis.shape[1]) < draw(st.sampled_from([0.0, 0.3]))] = 0.0
    goal = basis @ rng.dirichlet(np.full(sources, 0.3), groups).ravel() + rng.normal(size=rows) * draw(
        st.sampled_from([0.0, 0.1, 10.0])
    )
    basis *= 10.0 ** draw(st.integers(-3, 3))
    return basis.T @ basis, basis.T @ goal, groups, sources


def _objective(gram: np.ndarray, linear: np.ndarray, weights: np.ndarray) -> float:
    flat = weights.ravel()
    return float(flat @ gram @ flat / 2 - linear @ flat)


def _assert_shares(fit: SimplexFit) -> None:
    assert fit.weights.min(initial=0.0) >= 0
    np.testing.assert_allclose(fit.weights.sum(axis=1), 1.0, atol=1e-12)


@settings(deadline=None, max_examples=75)
@given(problems())
def test_the_optimality_conditions_hold(problem: ProblemArrays) -> None:
    gram, linear, groups, sources = problem
    fit = fit_simplex(gram, linear, groups, sources)
    _assert_shares(fit)
    slopes = (gram @ fit.weights.ravel() - linear).reshape(groups, sources)
    scale = max(np.abs(gram).max(), np.abs(linear).max(), np.finfo(float).tiny)
    above = (slopes - slopes.min(axis=1, keepdims=True)) / scale
    assert (fit.weights * above).max() <= 1e-9  # no share above 0 where the slope is not the group's least
    assert fit.residual <= 1e-9


def test_small_regions_of_sources_that_are_alike_are_fitted_as_well() -> None:
    """Shares that gradients and the first steps put at 0 are found again: their slopes are those of a small region."""
    for seed in range(1, 6):
        rng = np.random.default_rng(seed)
        basis = (rng.normal(size=(300, 100)) + 3 * rng.normal(size=(300, 1))) * np.repeat(np.logspace(0, -2, 10), 10)
        goal = basis @ rng.dirichlet(np.full(10, 0.4), 10).ravel() + 0.1 * rng.normal(size=300)
        gram, linear = basis.T @ basis, basis.T @ goal
        fit = fit_simplex(gram, linear, 10, 10)
        slopes = (gram @ fit.weights.ravel() - linear).reshape(10, 10) / np.abs(gram).max()
        assert (fit.weights * (slopes - slopes.min(axis=1, keepdims=True))).max() <= 1e-9


@settings(deadline=None, max_examples=15)
@given(problems(4))
def test_no_general_solver_does_better(problem: ProblemArrays) -> None:
    from scipy.optimize import minimize

    gram, linear, groups, sources = problem
    scale = max(np.abs(gram).max(), np.abs(linear).max(), np.finfo(float).tiny)
    gram, linear = gram / scale, linear / scale
    sums = np.repeat(np.eye(groups), sources, axis=1)
    other = minimize(
        lambda a: a @ gram @ a / 2 - linear @ a,
        np.full(groups * sources, 1 / sources),
        jac=lambda a: gram @ a - linear,
        bounds=[(0, 1)] * (groups * sources),
        constraints={"type": "eq", "fun": lambda a: sums @ a - 1, "jac": lambda a: sums},
        method="SLSQP",
        options={"ftol": 1e-14, "maxiter": 500},
    )
    theirs = np.clip(other.x, 0, None).reshape(groups, sources)
    theirs /= theirs.sum(axis=1, keepdims=True)
    ours = fit_simplex(gram, linear, groups, sources).weights
    assert _objective(gram, linear, ours) <= _objective(gram, linear, theirs) + 1e-9


@pytest.mark.parametrize(("groups", "sources"), [(1, 1), (3, 2), (10, 3), (30, 20)])
def test_known_weights_come_back(groups: int, sources: int) -> None:
    rng = np.random.default_rng(groups)
    basis = rng.normal(size=(3 * groups * sources, groups * sources))
    weights = rng.dirichlet(np.full(sources, 0.4), groups)
    weights[0] = np.eye(sources)[0]
    fit = fit_simplex(basis.T @ basis, basis.T @ (basis @ weights.ravel()), groups, sources)
    _assert_shares(fit)
    np.testing.assert_allclose(fit.weights, weights, atol=1e-10)
    again = fit_simplex(basis.T @ basis, basis.T @ (basis @ weights.ravel()), groups, sources)
    np.testing.assert_array_equal(fit.weights, again.weights)


def test_locked_groups_stay_to_the_bit_and_the_others_make_the_best_of_it() -> None:
    rng = np.random.default_rng(5)
    basis = rng.normal(size=(60, 12))
    goal = rng.normal(size=60) * 3
    gram, linear = basis.T @ basis, basis.T @ goal
    row = np.array([0.1, 0.2, 0.7])
    fit = fit_simplex(gram, linear, 4, 3, locked={2: row})
    np.testing.assert_array_equal(fit.weights[2], row)
    _assert_shares(fit)
    others = np.delete(basis, np.arange(6, 9), axis=1)
    left = goal - basis[:, 6:9] @ row
    alone = fit_simplex(others.T @ others, others.T @ left, 3, 3)
    np.testing.assert_allclose(np.delete(fit.weights, 2, axis=0), alone.weights, atol=1e-10)
    whole = fit_simplex(gram, linear, 4, 3, locked=dict(enumerate(np.eye(3)[[0, 1, 2, 0]])))
    np.testing.assert_array_equal(whole.weights, np.eye(3)[[0, 1, 2, 0]])


def test_what_the_problem_leaves_open_is_shared_equally() -> None:
    rng = np.random.default_rng(6)
    basis = rng.normal(size=(50, 3, 4))
    basis[:, 1] = 0.0  # a region without edges
    basis[:, 2, 3] = basis[:, 2, 0]  # two sources that are the same there
    weights = np.array([[0.5, 0.5, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.4, 0.1, 0.3, 0.2]])
    flat = basis.reshape(50, 12)
    fit = fit_simplex(flat.T @ flat, flat.T @ (flat @ weights.ravel()), 3, 4)
    np.testing.assert_allclose(fit.weights[0], weights[0], atol=1e-9)
    np.testing.assert_allclose(fit.weights[1], 0.25, atol=1e-12)
    np.testing.assert_allclose(fit.weights[2, 1:3], weights[2, 1:3], atol=1e-9)
    np.testing.assert_allclose(fit.weights[2, [0, 3]], 0.3, atol=1e-6)


def test_the_order_of_groups_and_sources_changes_nothing() -> None:
    rng = np.random.default_rng(8)
    basis = rng.normal(size=(40, 5, 4))
    goal = rng.normal(size=40) * 4
    order, turn = rng.permutation(5), rng.permutation(4)
    fits = [
        fit_simplex(flat.T @ flat, flat.T @ goal, 5, 4).weights
        for flat in (basis.reshape(40, 20), basis[:, order][:, :, turn].reshape(40, 20))
    ]
    np.testing.assert_allclose(fits[1], fits[0][order][:, turn], atol=1e-9)


def test_no_groups_and_a_linear_objective() -> None:
    assert fit_simplex(np.zeros((0, 0)), np.zeros(0), 0, 3).weights.shape == (0, 3)
    linear = np.array([1.0, 3.0, 2.0, -1.0, -4.0, -1.0])
    fit = fit_simplex(np.zeros((6, 6)), linear, 2, 3)
    np.testing.assert_allclose(fit.weights, [[0, 1, 0], [0.5, 0, 0.5]], atol=1e-12)
