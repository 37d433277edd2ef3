"""Lips of drawn people meet at rest: no teeth between them, and none in the other lip."""

from __future__ import annotations

import numpy as np
import pytest
from contacts import Subject, person
from lip_rays import OVERLAP, Lips

from facepipe.heads.assembly import average, make_head
from facepipe.heads.asset import asset
from facepipe.heads.lip_fit import fit_lips
from facepipe.heads.people import draw

MOST = 0.15  # cm that a lip may have to go


@pytest.fixture(scope="module")
def lips() -> Lips:
    return Lips(person(0))


def head(seed: int, *, closed: bool) -> Subject:
    return Subject(make_head(draw(seed).identity, closed=closed))


@pytest.mark.parametrize("seeds", [(0, 4, 5, 32), pytest.param(range(1, 101), marks=pytest.mark.slow)])
def test_lips_of_nobody_show_teeth_or_go_into_one_another(lips: Lips, seeds: tuple[int, ...]) -> None:
    apart, met = ([head(seed, closed=closed).neutral for seed in seeds] for closed in (False, True))
    assert sum(map(lips.teeth, met)) == 0 < sum(map(lips.teeth, apart))
    assert max(map(lips.overlap, met)) < OVERLAP < max(map(lips.overlap, apart))


def test_an_open_jaw_shows_teeth_as_it_would_without(lips: Lips) -> None:
    def shown(*, closed: bool) -> int:
        return sum(lips.teeth(head(seed, closed=closed).points({"jawOpen": 0.5})) for seed in range(1, 6))

    assert shown(closed=True) > 0.8 * shown(closed=False)


def test_lips_go_up_and_down_alone_and_no_skin_far_from_them() -> None:
    points = asset().points + np.tensordot(draw(12).identity.astype(np.float32), asset().modes, axes=1)
    moved = fit_lips(points) - points
    assert (moved[:, [0, 2]] == 0).all()
    assert 0.05 < np.abs(moved[:, 1]).max() < MOST
    corners = points[asset().landmarks[[60, 64]]]
    np.testing.assert_allclose(moved[asset().landmarks[[60, 64]]], 0.0, atol=0.01)
    far = np.linalg.norm(points - corners.mean(axis=0), axis=1) > np.linalg.norm(corners[1] - corners[0])
    assert np.abs(moved[far]).max() < 0.015  # cm
    assert (moved[asset().landmarks[[51, 62]], 1] < 0).all()
    assert (moved[asset().landmarks[[57, 66]], 1] > 0).all()


def test_lips_that_meet_stay() -> None:
    points = fit_lips(asset().points)
    assert np.abs(fit_lips(points) - points).max() < 0.003  # cm


def test_the_head_that_modes_add_to_stays_as_it_is() -> None:
    mouth = asset().landmarks[48:]
    np.testing.assert_array_equal(average().meshes[0].points[mouth], asset().points[mouth])
