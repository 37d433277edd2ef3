"""The distance that landmark errors are measured by."""

from __future__ import annotations

import numpy as np
import pytest

from facepipe.geometry.landmarks import eye_distance


def marks() -> np.ndarray:
    return np.random.default_rng(0).uniform(0, 255, (68, 2)).round()


def test_it_is_that_of_the_outer_corners_alone() -> None:
    own = marks()
    own[36], own[45] = (10.0, 20.0), (40.0, 60.0)
    assert eye_distance(own) == pytest.approx(50)
    others = np.setdiff1d(np.arange(68), (36, 45))
    own[others] += 7.0
    assert eye_distance(own) == pytest.approx(50)


def test_it_grows_with_the_picture_and_turns_with_it() -> None:
    own = marks()
    cos, sin = np.cos(0.3), np.sin(0.3)
    turned = 3 * own @ np.array([[cos, sin], [-sin, cos]]) + (5, 8)
    assert eye_distance(turned) == pytest.approx(3 * eye_distance(own))


def test_whole_numbers_of_any_type_are_pixels() -> None:
    assert eye_distance(marks().astype(np.uint8)) == eye_distance(marks())
