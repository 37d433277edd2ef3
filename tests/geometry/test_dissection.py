"""Factors by nested dissection against dense algebra."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import block_diag, csr_array, diags_array
from solids import ball

from facepipe.geometry.dissection import Dissection
from facepipe.geometry.gradient_system import cotangent_weights, incidence


def _surface(seed: int, rings: int) -> tuple[csr_array, np.ndarray, np.ndarray]:
    """(n, n) of a ball, (n, 3, 3) of some of its points, and their places."""
    rng = np.random.default_rng(seed)
    points, triangles = ball(rings)
    pairs, weights = cotangent_weights(points, triangles)
    differences = incidence(pairs, len(points))
    shared = differences.T @ diags_array(weights) @ differences + diags_array(rng.uniform(0.01, 1.0, len(points)))
    normals = rng.normal(size=points.shape) * (rng.random(len(points)) < 0.7)[:, None]
    return csr_array(shared), normals[:, :, None] * normals[:, None, :], np.asarray(points)


def _dense(shared: csr_array, blocks: np.ndarray) -> np.ndarray:
    whole = np.kron(shared.toarray(), np.eye(3))
    for place, block in enumerate(blocks):
        whole[3 * place : 3 * place + 3, 3 * place : 3 * place + 3] += block
    return whole


@pytest.mark.parametrize("rings", [4, 12, 20])  # 26 points, less than are cut, 266 and 762
def test_solutions_are_those_of_the_dense_matrix(rings: int) -> None:
    shared, blocks, places = _surface(1, rings)
    right = np.random.default_rng(2).normal(size=(3 * len(places), 5))
    order = Dissection(shared, places)
    for stronger in (1.0, 7.0):  # other values of the same pattern
        factor, whole = order.factor(shared * stronger, blocks), _dense(shared * stronger, blocks)
        expected = np.linalg.solve(whole, right)
        np.testing.assert_allclose(factor.solve(right), expected, atol=1e-9)
        halfway = factor.forward(right)
        np.testing.assert_allclose(halfway.T @ halfway, right.T @ expected, rtol=1e-9)


def test_pieces_apart_and_values_that_are_missing_are_solved_too() -> None:
    shared, blocks, places = _surface(3, 12)
    both = csr_array(block_diag([shared, shared]))
    order = Dissection(both, np.concatenate([places, places + 0.1]))  # one in the other
    fewer = csr_array(diags_array(both.diagonal()))  # less than the pattern has
    twice = np.concatenate([blocks, blocks])
    right = np.random.default_rng(4).normal(size=(6 * len(places), 2))
    for matrix in (both, fewer):
        expected = np.linalg.solve(_dense(matrix, twice), right)
        np.testing.assert_allclose(order.factor(matrix, twice).solve(right), expected, atol=1e-9)


def test_a_matrix_that_is_not_positive_definite_is_refused() -> None:
    shared, blocks, places = _surface(5, 12)
    with pytest.raises(np.linalg.LinAlgError):
        Dissection(shared, places).factor(shared, blocks - 100.0 * np.eye(3))
