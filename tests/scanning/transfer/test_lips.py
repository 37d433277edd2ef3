"""Lips that are made to meet, of a mouth whose opening is a formula."""

from __future__ import annotations

import numpy as np
import plain_heads
import pytest

from facepipe.scanning.transfer.companions import Motion
from facepipe.scanning.transfer.finish import finished
from facepipe.scanning.transfer.lips import Lips, as_shut, figures, half_met, lips_of, met
from facepipe.scanning.transfer.pieces import Inside, pieces_of

_HALF = 22.0  # mm from the mouth's middle to its corners


def _mouth(gap: float) -> tuple[np.ndarray, Lips]:
    """The plain head with lips `gap` mm apart in the middle, where they are 2 mm apart as it comes."""
    points, triangles = plain_heads.skin()
    points = points.copy()
    away = points[:, :2] - plain_heads.MOUTH
    points[:, 1] += 0.5 * (gap - 2.0) * _bump(points) * np.sign(away[:, 1]) * np.exp(-((away[:, 1] / 12.0) ** 2))
    marks = plain_heads.landmarks()
    lips = lips_of(points, triangles, marks)
    assert lips is not None
    return points, lips


def _bump(points: np.ndarray) -> np.ndarray:
    return np.clip(1.0 - (points[:, 0] / _HALF) ** 2, 0.0, None)


def _jaw(points: np.ndarray, way: float = 18.0) -> np.ndarray:
    below = points[:, 1] < plain_heads.MOUTH[1]
    return np.outer(way * below * _bump(points), [0.0, -1.0, -0.3])


@pytest.mark.parametrize("gap", [0.0, 0.8, 2.0])
def test_the_opening_is_that_of_the_formula(gap: float) -> None:
    points, lips = _mouth(gap)
    for pose, opened in ((points, 0.0), (points + _jaw(points), 18.0)):
        truth = (gap + opened) * _bump(lips.on_rims(points).mean(axis=0))
        assert np.abs(lips.gaps(pose) - truth)[3:-3].max() < 0.1 + 0.035 * opened  # corners are points


@pytest.mark.parametrize("gap", [0.0, 0.3, 1.0, 2.0])
@pytest.mark.parametrize("much", [0.6, 1.0, 1.4])
def test_lips_meet_whatever_was_carried(gap: float, much: float) -> None:
    points, lips = _mouth(gap)
    jaw = _jaw(points)
    close = met(points, lips, jaw, -much * jaw)
    half = half_met(points, lips, jaw, close)
    found = figures(points, lips, jaw, close, half)
    assert found.gap_most <= 0.1
    assert found.over_most <= 0.5
    assert found.half_most <= 0.2
    assert found.lip_flips == 0
    assert (half is None) == (gap <= 0.3)
    # both lips give way, and nothing does beside the mouth
    beside = np.abs(points[:, 0]) > _HALF + 1.0
    assert np.allclose(close[beside], -much * jaw[beside])


def test_lips_that_meet_are_as_far_in_front_of_one_another_as_at_rest() -> None:
    points, lips = _mouth(0.5)
    jaw = _jaw(points)
    close = -jaw + np.outer(points[:, 1] < plain_heads.MOUTH[1], [0.0, 0.0, 3.0]) * _bump(points)[:, None]
    depth = (points + jaw + met(points, lips, jaw, close))[:, 2] - points[:, 2]
    upper, lower = lips.on_rims(np.outer(depth, [0.0, 0.0, 1.0]))[..., 2]
    assert np.abs(upper - lower)[8:-8].max() < 0.3


def test_columns_go_aside_with_the_mouth() -> None:
    points, lips = _mouth(1.0)
    aside = np.tile([9.0, 0.0, 0.0], (len(points), 1))
    assert np.allclose(lips.gaps(points + aside), lips.gaps(points), atol=1e-6)


def test_shapes_open_and_cross_lips_where_those_of_the_template_do() -> None:
    points, lips = _mouth(0.2)
    own = lips.gaps(points)
    rest = np.zeros_like(own)
    opens, crosses = _jaw(points, 1.5), _jaw(points, -3.0)
    assert np.allclose(as_shut(points, lips, opens, rest, rest + 5.0), opens)
    for delta in (opens, crosses):
        held = lips.gaps(points + as_shut(points, lips, delta, rest, rest))
        assert held.max() < own.max() + 0.05
        assert held.min() > -0.4
    assert lips.gaps(points + as_shut(points, lips, crosses, rest, rest - 2.0)).min() == pytest.approx(-2.3, abs=0.1)


def test_a_mouth_without_an_opening_has_no_lips() -> None:
    points, triangles = plain_heads.skin(holes=False)
    assert lips_of(points, triangles, plain_heads.landmarks()) is None
    assert lips_of(points, triangles[:0], plain_heads.landmarks()) is None


@pytest.mark.parametrize("own", [False, True])
def test_mouth_close_of_a_head_is_made_for_its_jaw(*, own: bool) -> None:
    head = plain_heads.head()
    pieces = pieces_of(head.points, head.triangles, head.landmarks)
    nothing = np.zeros(0, np.int64)
    inside = Inside(points=head.points, balls={}, upper=nothing, lower=nothing, tongue=nothing)
    jaw = _jaw(head.points) * (head.part == 0)[:, None]
    carried = {"mouthClose": -0.7 * jaw}
    made = finished(
        head.points,
        head.triangles,
        head.landmarks,
        pieces,
        Motion(neutral=head.points, deltas={}, inside=inside),
        carried if own else {"jawOpen": jaw, **carried},
        jaw if own else None,
    )
    shape = made.verdicts[-1]
    assert (shape.name, shape.verdict) == ("mouthClose", "made")
    assert shape.lips is not None
    assert shape.lips.gap_most <= 0.1
    assert shape.lips.half_most <= 0.2
    assert list(made.inbetweens["mouthClose"]) == [0.5]
    assert ("jawOpen" in made.deltas) != own
