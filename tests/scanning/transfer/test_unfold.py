"""Triangles that turn over, on a sheet."""

from __future__ import annotations

import numpy as np

from facepipe.geometry.polygons import flipped_triangles
from facepipe.scanning.transfer.unfold import unfolded

_SIDE = 9


def _sheet() -> tuple[np.ndarray, np.ndarray]:
    x, y = np.meshgrid(np.arange(float(_SIDE)), np.arange(float(_SIDE)))
    first = (np.arange(_SIDE - 1)[:, None] * _SIDE + np.arange(_SIDE - 1)).ravel()
    below = np.stack([first, first + 1, first + _SIDE], axis=1)
    above = np.stack([first + 1, first + _SIDE + 1, first + _SIDE], axis=1)
    return np.stack([x.ravel(), y.ravel(), np.zeros(_SIDE**2)], axis=1), np.concatenate([below, above])


def test_triangles_turn_back_and_held_points_stay() -> None:
    points, triangles = _sheet()
    middle = len(points) // 2
    ended = points + np.array([0.0, 0.0, 1.0])
    ended[middle, 0] += 1.6
    held = np.zeros(len(points), bool)
    assert flipped_triangles(points, ended, triangles).any()
    back = unfolded(points, ended, triangles, triangles, held)
    assert not flipped_triangles(points, back, triangles).any()
    far = np.abs(points[:, :2] - points[middle, :2]).max(axis=1) > 3
    assert np.array_equal(back[far], ended[far])
    held[middle] = True
    assert np.array_equal(unfolded(points, ended, triangles, triangles, held)[middle], ended[middle])


def test_a_motion_that_turns_nothing_over_is_left_alone() -> None:
    points, triangles = _sheet()
    ended = points * [1.0, 2.0, 1.0]
    assert np.array_equal(unfolded(points, ended, triangles, triangles, np.zeros(len(points), bool)), ended)
