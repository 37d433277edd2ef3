"""Similarity fits against known transforms, a brute-force optimum, and sets that leave the rotation open."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from facepipe.core.errors import InputError
from facepipe.geometry.similarity import Similarity, fit_similarities, fit_similarity

LINE = np.outer([-1.0, 0.0, 0.5, 2.0], [1.0, 2.0, -0.5])


def rotation(rng: np.random.Generator) -> np.ndarray:
    Q, R = np.linalg.qr(rng.normal(size=(3, 3)))
    Q *= np.sign(np.diag(R))
    return Q * np.linalg.det(Q)


def angle(turn: np.ndarray) -> float:
    return float(np.arctan2(np.linalg.norm(turn - turn.T) / np.sqrt(8), (np.trace(turn) - 1) / 2))


def proper(turn: np.ndarray) -> bool:
    return bool(np.allclose(turn @ turn.T, np.eye(3), atol=1e-12) and np.linalg.det(turn) > 0)


def error(source: np.ndarray, target: np.ndarray, weights: np.ndarray, turn: np.ndarray, scale: float) -> float:
    """Weighted squared error with the best translation."""
    moved = target - scale * source @ turn.T
    moved = moved - np.average(moved, axis=0, weights=weights)
    return float((weights * (moved**2).sum(axis=1)).sum())


def dense_rotation(vector: np.ndarray) -> np.ndarray:
    """Rodrigues: the rotation by |vector| about it."""
    x, y, z = vector
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    theta = np.linalg.norm(vector)
    return np.eye(3) + np.sinc(theta / np.pi) * cross + 0.5 * np.sinc(theta / (2 * np.pi)) ** 2 * cross @ cross


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(3, 40), flat=st.booleans(), far=st.sampled_from([0, 1, 1e4]))
@settings(deadline=None, max_examples=60)
def test_a_similarity_is_found_again(seed: int, count: int, flat: bool, far: float) -> None:
    rng = np.random.default_rng(seed)
    source = rng.normal(size=(count, 3)) * [1, 2, 0 if flat else 3] + far
    turn, scale, shift = rotation(rng), float(np.exp(rng.normal())), rng.normal(size=3)
    found = fit_similarity(source, scale * source @ turn.T + shift, weights=rng.random(count) + 0.1)
    tolerance = 1e-8 * max(far, 1)
    np.testing.assert_allclose(found.rotation, turn, atol=tolerance)
    assert found.scale == pytest.approx(scale, rel=tolerance)
    np.testing.assert_allclose(found.apply(source), scale * source @ turn.T + shift, atol=tolerance)


def test_undo_moves_points_back() -> None:
    rng = np.random.default_rng(7)
    points, turn, shift = rng.normal(size=(2, 5, 3)), rotation(rng), rng.normal(size=3)
    known = Similarity(rotation=turn, translation=shift, scale=2.5)
    np.testing.assert_allclose(known.undo(2.5 * points @ turn.T + shift), points, atol=1e-12)


@pytest.mark.parametrize("scale", [True, False])
@pytest.mark.parametrize("mirrored", [True, False])
@pytest.mark.parametrize("seed", range(5))
def test_no_other_rotation_or_scale_is_better(seed: int, mirrored: bool, scale: bool) -> None:
    rng = np.random.default_rng(seed)
    source, weights = rng.normal(size=(12, 3)), rng.random(12)
    target = (source * [1, 1, -1] if mirrored else source) @ rotation(rng).T * 1.7 + 0.3 * rng.normal(size=(12, 3))
    found = fit_similarity(source, target, scale=scale, weights=weights)
    assert proper(found.rotation)
    assert scale or found.scale == 1.0
    best = error(source, target, weights, found.rotation, found.scale)
    residual = target - found.apply(source)
    assert (weights * (residual**2).sum(axis=1)).sum() == pytest.approx(best, rel=1e-9)  # the translation is the best
    others = [rotation(rng) for _ in range(300)]
    others += [dense_rotation(step) @ found.rotation for step in rng.normal(size=(300, 3)) * rng.choice([1e-3, 0.1], 1)]
    for turn in others:
        for factor in (0.99, 1.0, 1.01) if scale else (1.0,):
            assert error(source, target, weights, turn, factor * found.scale) >= best * (1 - 1e-12)


def test_the_mirror_image_gets_a_rotation() -> None:
    source = np.random.default_rng(0).normal(size=(30, 3)) * [1, 2, 3]
    found = fit_similarity(source, source * [-1, 1, 1])
    assert proper(found.rotation)
    np.testing.assert_allclose(found.rotation, np.eye(3), atol=0.5)  # the shortest axis is the one given up


def test_the_weight_says_which_points_count() -> None:
    rng = np.random.default_rng(1)
    source = rng.normal(size=(20, 3))
    target = 2.0 * source @ rotation(rng).T + 1.0
    spoilt = target.copy()
    spoilt[:5] += 10.0
    weights = np.r_[np.zeros(5), np.ones(15)]
    np.testing.assert_allclose(fit_similarity(source, spoilt, weights=weights).apply(source), target, atol=1e-10)
    doubled = fit_similarity(np.r_[source, source[:3]], np.r_[spoilt, spoilt[:3]])
    counted = fit_similarity(source, spoilt, weights=np.r_[np.full(3, 2.0), np.ones(17)])
    np.testing.assert_allclose(counted.apply(source), doubled.apply(source), atol=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_a_line_turns_by_the_angle_between_the_lines(seed: int) -> None:
    turn = rotation(np.random.default_rng(seed))
    target = 3.0 * LINE @ turn.T + [1, 2, 3]
    found = fit_similarity(LINE, target)
    direction = LINE[0] / np.linalg.norm(LINE[0])
    assert proper(found.rotation)
    assert found.scale == pytest.approx(3.0)
    np.testing.assert_allclose(found.apply(LINE), target, atol=1e-9)
    assert angle(found.rotation) == pytest.approx(np.arccos(direction @ turn @ direction), abs=1e-7)


def test_a_line_that_only_moved_does_not_turn_and_a_reversed_one_makes_a_half_turn() -> None:
    still = fit_similarity(LINE, LINE + np.array([5, 0, 0]))
    np.testing.assert_allclose(still.rotation, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(still.translation, [5, 0, 0], atol=1e-12)
    for slightly in (0.0, 1e-9, 1e-6):
        reversed_line = -LINE + slightly * LINE[:, [1, 2, 0]]
        found = fit_similarity(LINE, reversed_line)
        assert proper(found.rotation)
        np.testing.assert_allclose(found.apply(LINE), reversed_line, atol=1e-7)


def test_a_line_thick_by_rounding_alone_is_a_line() -> None:
    rng = np.random.default_rng(3)
    source = (LINE + 1e-6 * rng.normal(size=LINE.shape)) + 10.0
    target = (LINE + 1e-6 * rng.normal(size=LINE.shape)) - 10.0
    assert angle(fit_similarity(source, target).rotation) < 1e-5


@pytest.mark.parametrize("count", [1, 2, 1000])
@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (0.1, -1234.7, 3e5)])
def test_equal_points_only_move(count: int, place: tuple[float, float, float]) -> None:
    source = np.tile(place, (count, 1))
    spread = np.random.default_rng(0).normal(size=(count, 3))
    for start, target in ((source, source + np.array([1, 2, 3])), (source, spread), (spread, source)):
        found = fit_similarity(start, target)
        np.testing.assert_array_equal(found.rotation, np.eye(3))
        assert found.scale == 1.0
        np.testing.assert_allclose(found.translation, target.mean(axis=0) - start.mean(axis=0), atol=1e-9)


@pytest.mark.parametrize("size", [1e-150, 1e-30, 1e30, 1e150])
def test_sizes_far_from_one_are_fitted_as_well(size: float) -> None:
    rng = np.random.default_rng(2)
    source, turn = rng.normal(size=(9, 3)), rotation(rng)
    found = fit_similarity(source, size * source @ turn.T)
    np.testing.assert_allclose(found.rotation, turn, atol=1e-10)
    assert found.scale == pytest.approx(size)


def test_groups_are_fitted_as_if_alone() -> None:
    rng = np.random.default_rng(4)
    groups = rng.permutation(np.repeat([0, 1, 2, 4, 5], [20, 1, 7, 4, 2]))  # no point has group 3
    source, target, weights = rng.normal(size=(34, 3)), rng.normal(size=(34, 3)), rng.random(34)
    source[groups == 4], target[groups == 4] = LINE, 2 * LINE[:, [2, 0, 1]]
    for scale in (True, False):
        together = fit_similarities(source, target, groups, scale=scale, weights=weights)
        for group in (0, 1, 2, 4, 5):
            own = groups == group
            alone = fit_similarity(source[own], target[own], scale=scale, weights=weights[own])
            np.testing.assert_allclose(together[group].apply(source), alone.apply(source), atol=1e-10)
            np.testing.assert_allclose(together.apply(source, groups)[own], alone.apply(source[own]), atol=1e-10)
        np.testing.assert_array_equal(together[3].apply(source), source)


@pytest.mark.parametrize("which", ["source", "target"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_numbers_that_are_not_finite_are_refused(which: str, value: float) -> None:
    given = {"source": LINE.copy(), "target": LINE.copy()}
    given[which][1, 2] = value
    with pytest.raises(InputError, match=f"^{which}: "):
        fit_similarity(**given)
