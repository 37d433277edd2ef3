"""Lids that close over a ball whose radius is known."""

from __future__ import annotations

import numpy as np
import plain_heads
import pytest

from facepipe.geometry.balls import RadialSurface
from facepipe.scanning.transfer.lids import PAINT, SHUT, Aperture, Globe, aperture_of, closed, lid_figures, slid


def _eye(side: str = "Left", *, ball: bool = True) -> tuple[np.ndarray, np.ndarray, Aperture]:
    points, triangles = plain_heads.skin()
    eye = aperture_of(points, triangles, plain_heads.landmarks(), side, _globe(side, ball=ball))
    assert isinstance(eye, Aperture)
    return points, triangles, eye


def _globe(side: str, *, ball: bool = True) -> Globe:
    centre = np.append(plain_heads.EYES[side], -12.0)
    directions = np.random.default_rng(0).normal(size=(2000, 3))
    surface = centre + plain_heads.BALL * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return Globe(centre=centre, radius=plain_heads.BALL, surface=RadialSurface(surface, centre) if ball else None)


def test_the_aperture_is_the_hole_between_the_lids() -> None:
    _, _, eye = _eye()
    middle = np.abs(eye.columns).argmin()
    tall = np.arcsin(4.5 / (plain_heads.BALL + plain_heads.LID))  # of an almond 4.5 mm high to each side
    assert np.isclose(eye.upper[middle], tall, atol=0.02)
    assert np.isclose(eye.lower[middle], -tall, atol=0.02)
    assert np.isclose(np.ptp(eye.columns), 2 * np.arcsin(11.0 / (plain_heads.BALL + plain_heads.LID)), atol=0.15)


@pytest.mark.parametrize("side", ["Left", "Right"])
@pytest.mark.parametrize("ball", [True, False])
def test_a_blink_closes_the_eye_from_nothing(side: str, *, ball: bool) -> None:
    points, triangles, eye = _eye(side, ball=ball)
    blink = closed(points, triangles, eye, np.zeros_like(points))
    figures = lid_figures(points, blink.delta, triangles, eye)
    assert figures.gap_mean <= 0.1
    assert figures.gap_most <= 0.4
    assert figures.lid_flips == 0
    assert figures.in_ball <= figures.in_ball_neutral + 0.1
    # the other eye, the mouth and the brow's upper end stay where they are
    far = np.linalg.norm(points[:, :2] - plain_heads.EYES[side], axis=1) > 25.0
    assert not blink.delta[far].any()


def test_lids_stay_over_the_ball_on_the_way() -> None:
    points, triangles, eye = _eye()
    blink = closed(points, triangles, eye, np.zeros_like(points))
    margin = eye.near[eye.distance < 0.5]
    lid = plain_heads.BALL + plain_heads.LID
    for delta in (*blink.inbetweens.values(), blink.delta):
        assert np.linalg.norm((points + delta)[margin] - eye.globe.centre, axis=1).min() > lid - 0.05
    straight = (points + 0.5 * blink.delta)[margin]
    assert np.linalg.norm(straight - eye.globe.centre, axis=1).min() < lid - 0.5


def test_the_blink_takes_what_was_carried_beyond_the_lids() -> None:
    points, triangles, eye = _eye()
    carried = np.tile([0.0, 0.0, 0.3], (len(points), 1))
    blink = closed(points, triangles, eye, carried)
    far = np.linalg.norm(points[:, :2] - plain_heads.EYES["Left"], axis=1) > 30.0
    assert np.allclose(blink.delta[far], carried[far])
    assert lid_figures(points, blink.delta, triangles, eye).gap_most <= 0.4


def test_shapes_that_press_lids_into_the_ball_are_held_off() -> None:
    points, triangles, eye = _eye()
    away = np.linalg.norm(points[:, :2] - plain_heads.EYES["Left"], axis=1)
    carried = np.zeros_like(points)
    carried[:, 2] = -4.0 * np.clip(1.0 - away / 20.0, 0.0, 1.0)
    moved = points + slid(points, triangles, eye, carried)
    assert np.linalg.norm((points + carried)[eye.near] - eye.globe.centre, axis=1).min() < plain_heads.BALL - 0.5
    assert np.linalg.norm(moved[eye.near] - eye.globe.centre, axis=1).min() > plain_heads.BALL - 0.1


def test_eyes_without_an_aperture_are_paint_or_shut() -> None:
    points, triangles = plain_heads.skin(holes=False)
    marks = plain_heads.landmarks()
    assert aperture_of(points, triangles, marks, "Left", _globe("Left")) == PAINT
    marks[42:48, 1] = marks[[42, 45], 1].mean() + 0.2 * (marks[42:48, 1] - marks[[42, 45], 1].mean())
    assert aperture_of(points, triangles, marks, "Left", _globe("Left")) == SHUT


def test_a_nose_before_the_inner_corner_is_no_lid() -> None:
    points, triangles, eye = _eye()
    middle = np.array([2.0, plain_heads.EYES["Left"][1] - 2.0, 16.0])
    wall = middle + np.array([[0.0, -25, -6], [0, 25, -6], [0, 25, 12], [0, -25, 12]])
    count = len(points)
    both = np.concatenate([points, wall])
    more = np.concatenate([triangles, np.array([[0, 1, 2], [0, 2, 3]]) + count])
    found = aperture_of(both, more, plain_heads.landmarks(), "Left", eye.globe)
    assert isinstance(found, Aperture)
    assert np.allclose(found.columns, eye.columns)
