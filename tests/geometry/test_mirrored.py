"""Mirrored landmarks differ from true ones, over people, expressions, units and places."""

from __future__ import annotations

import numpy as np
import pytest
from scan_actors import ict

from facepipe.geometry.landmarks import mirror_ratio, mirrored

SOLID = np.array([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3], [1, 1, 5]])


def people(count: int, seed: int) -> np.ndarray:
    """(count, 68, 3) landmarks of identities of all modes, some with open jaws, jittered by 1.5 mm."""
    model, rng = ict(), np.random.default_rng(seed)
    person = np.tensordot(rng.standard_normal((count, 100)), model.identity[:, model.landmarks], axes=1)
    jaw = model.deltas[model.names.index("jawOpen"), model.landmarks] * rng.integers(0, 2, (count, 1, 1))
    return model.neutral[model.landmarks] + person + jaw + 1.5 * rng.standard_normal((count, 68, 3))


def test_no_person_is_mirrored_and_every_mirror_image_is() -> None:
    reference = ict().neutral[ict().landmarks]
    for index, points in enumerate(people(200, 4)):
        rng = np.random.default_rng(index)
        turn, _ = np.linalg.qr(rng.standard_normal((3, 3)))
        turn *= np.sign(np.linalg.det(turn))
        placed = 10.0 ** rng.uniform(-3, 3) * points @ turn.T + rng.normal(size=3) * 1000
        flip = np.where(np.arange(3) == index % 3, -1.0, 1.0)
        assert mirror_ratio(placed, reference) < 0.4
        assert mirror_ratio(placed * flip, reference) > 2.5


def test_unknown_landmarks_are_left_out() -> None:
    reference, points = ict().neutral[ict().landmarks], people(1, 5)[0]
    points[17:40] = np.nan
    assert not mirrored(points, reference)
    assert mirrored(points * [1, 1, -1], reference)


def test_few_landmarks_raise_no_false_alarm() -> None:
    reference, rng = ict().neutral[ict().landmarks], np.random.default_rng(6)
    for points in people(200, 6):
        points[rng.permutation(68)[8:]] = np.nan
        assert not mirrored(points, reference)


def test_the_ratio_is_that_of_exact_fits() -> None:
    assert mirror_ratio(SOLID, SOLID) < 1e-6
    assert mirror_ratio(SOLID * [1, -1, 1], SOLID) > 1e6
    flat = SOLID * [1, 1, 0]
    assert mirror_ratio(flat * [-1, 1, 1], flat) == pytest.approx(1.0, abs=1e-3)  # a half-turn does what a mirror does
