"""Factors of systems with three unknowns a point, and the order that their points are eliminated in."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import csr_array

from facepipe.geometry.dissection import dissect
from facepipe.geometry.elimination import Elimination
from facepipe.geometry.point_factor import PointFactor


def _grid(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Places and links of a grid, cells with one diagonal."""
    number = np.arange(rows * columns).reshape(rows, columns)
    steps = [(number[:-1], number[1:]), (number[:, :-1], number[:, 1:]), (number[:-1, :-1], number[1:, 1:])]
    links = np.concatenate([np.stack([a.ravel(), b.ravel()], axis=1) for a, b in steps])
    x, y = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    return np.stack([x.ravel(), y.ravel(), np.sin(x + y).ravel()], axis=1).astype(np.float64), links


def _system(count: int, links: np.ndarray, rng: np.random.Generator) -> tuple[csr_array, np.ndarray]:
    """Positive definite: shared values on the links and on points, and a block a point."""
    dense = np.zeros((count, count))
    for a, b in links:
        weight = rng.uniform(0.1, 3.0)
        dense[[a, b, a, b], [a, b, b, a]] += weight * np.array([1.0, 1.0, -1.0, -1.0])
    dense[np.diag_indices(count)] += 0.05
    normals = rng.normal(size=(count, 3))
    return csr_array(dense), rng.uniform(0, 4, (count, 1, 1)) * normals[:, :, None] * normals[:, None, :]


def _dense(shared: csr_array, blocks: np.ndarray) -> np.ndarray:
    matrix = np.kron(shared.toarray(), np.eye(3))
    for point, block in enumerate(blocks):
        matrix[3 * point : 3 * point + 3, 3 * point : 3 * point + 3] += block
    return matrix


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    count=st.integers(1, 60),
    density=st.floats(0.0, 0.4),
    most=st.integers(1, 70),
    alike=st.booleans(),
)
def test_solutions_are_those_of_the_dense_system(seed: int, count: int, density: float, most: int, alike: bool) -> None:
    """Whatever is linked, in one piece or many, wherever the points are said to be."""
    rng = np.random.default_rng(seed)
    links = np.argwhere(np.triu(rng.uniform(size=(count, count)) < density, 1))
    places = np.zeros((count, 3)) if alike else rng.normal(size=(count, 3))
    shared, blocks = _system(count, links, rng)
    factor = PointFactor(Elimination.of(places, links, most), shared, blocks)
    right = rng.normal(size=(3 * count, 4))
    dense = _dense(shared, blocks)
    solved = np.linalg.solve(dense, right)
    assert np.allclose(factor.solve(right), solved, rtol=1e-9, atol=1e-9)
    half = factor.half(right)
    assert np.allclose(half.T @ half, right.T @ solved, rtol=1e-9, atol=1e-9)
    assert np.allclose(factor.back(half[:, 0]), solved[:, 0], rtol=1e-9, atol=1e-9)


def test_blocks_between_linked_points_count() -> None:
    """Three axes of a point mixed with those of another, whichever of the two is eliminated first."""
    places, links = _grid(7, 9)
    rng = np.random.default_rng(6)
    elimination = Elimination.of(places, links, 8)
    count = len(places)
    between = rng.normal(size=(len(elimination.links), 3, 3))
    shared, blocks = _system(count, links, rng)
    blocks = blocks + 40.0 * np.eye(3)
    dense = _dense(shared, blocks)
    for (low, high), block in zip(np.stack(np.divmod(elimination.links, count), axis=1), between, strict=True):
        dense[3 * low : 3 * low + 3, 3 * high : 3 * high + 3] += block
        dense[3 * high : 3 * high + 3, 3 * low : 3 * low + 3] += block.T
    right = rng.normal(size=(3 * count, 2))
    solved = PointFactor(elimination, shared, blocks, between).solve(right)
    assert np.allclose(dense @ solved, right, atol=1e-9)
    with pytest.raises(ValueError, match="not positive definite"):
        PointFactor(elimination, shared, blocks, np.full_like(between, np.nan))


def test_a_surface_is_solved_too() -> None:
    """Many fronts, with complements that pass several of them."""
    places, links = _grid(23, 31)
    rng = np.random.default_rng(2)
    clique = rng.choice(len(places), 9, replace=False)  # as a landmark far from where it should be
    links = np.concatenate([links, clique[np.stack(np.triu_indices(9, 1), axis=1)]])
    shared, blocks = _system(len(places), links, rng)
    right = rng.normal(size=(3 * len(places), 5))
    elimination = Elimination.of(places, links, 12)
    assert len(elimination.fronts) > 60
    solved = PointFactor(elimination, shared, blocks).solve(right)
    assert np.allclose(_dense(shared, blocks) @ solved, right, atol=1e-9)


def test_the_right_side_stays_as_it_was() -> None:
    places, links = _grid(8, 9)
    rng = np.random.default_rng(5)
    shared, blocks = _system(len(places), links, rng)
    factor = PointFactor(Elimination.of(places, links, 10), shared, blocks)
    right = rng.normal(size=(3 * len(places), 3))
    before = right.copy()
    half = factor.half(right)
    kept = half.copy()
    factor.back(half)
    assert np.array_equal(right, before)
    assert np.array_equal(half, kept)


def test_linked_points_lie_above_each_other() -> None:
    places, links = _grid(30, 40)
    links = np.concatenate([links, [[3, 1100], [17, 600]]])
    part = dissect(places, links, 20)
    for a, b in part[links]:
        low, high = sorted((int(a), int(b)))
        assert high >> (high.bit_length() - low.bit_length()) == low


def test_a_grid_is_parted_by_about_a_row() -> None:
    places, links = _grid(60, 60)
    part = dissect(places, links, 40)
    assert np.count_nonzero(part == 1) <= 62
    sides = [np.count_nonzero([int(p) >> (int(p).bit_length() - 2) == side for p in part[part > 1]]) for side in (2, 3)]
    assert min(sides) > 0.35 * len(part)
    # dense blocks of a good order hold about 8 n log2 n values for one unknown a point, and nine times that for three
    assert Elimination.of(places, links).size < 9 * 8 * len(part) * np.log2(len(part))


def test_what_is_not_positive_definite_is_refused() -> None:
    places, links = _grid(5, 5)
    shared, blocks = _system(25, links, np.random.default_rng(1))
    with pytest.raises(ValueError, match="not positive definite"):
        PointFactor(Elimination.of(places, links, 6), shared, blocks - 40.0 * np.eye(3))
    with pytest.raises(ValueError, match="not positive definite"):
        PointFactor(Elimination.of(places, links, 6), shared, np.full((25, 3, 3), np.nan))


def test_values_between_points_that_are_not_linked_are_refused() -> None:
    places, links = _grid(5, 5)
    shared, blocks = _system(25, links, np.random.default_rng(1))
    with pytest.raises(ValueError, match="not linked"):
        PointFactor(Elimination.of(places, links[1:], 6), shared, blocks)
