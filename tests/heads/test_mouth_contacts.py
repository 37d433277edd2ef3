"""Teeth of drawn people stay behind their lips, whatever expressions come together."""

from __future__ import annotations

import numpy as np
import pytest
from contacts import COMBINED, SINGLE, Subject, draw_combinations, expressions, mouth_sheet, person

from facepipe.geometry.contacts import Sheet


@pytest.fixture(scope="module")
def average() -> Subject:
    return person(0)


@pytest.fixture(scope="module")
def mouth(average: Subject) -> Sheet:
    found: Sheet = mouth_sheet(average)
    return found


def test_no_shape_of_the_average_head_brings_teeth_through_lips(average: Subject, mouth: Sheet) -> None:
    """Those that move neither lips nor teeth are as the head at rest."""
    near = np.unique(np.concatenate([mouth.outer, mouth.hard]))
    posed = {name: average.points({name: 1.0}) for name in expressions(average)}
    moving = {name for name, points in posed.items() if (points[near] != average.neutral[near]).any()}
    assert len(moving) > 20
    check(mouth, {"rest": average.neutral} | {name: posed[name] for name in moving})


@pytest.mark.parametrize("seed", [2, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (14, 18, 23, 24))])
def test_no_rolled_lip_of_others_lets_teeth_through(seed: int, mouth: Sheet) -> None:
    """The shapes that are the worst."""
    head = person(seed)
    check(mouth, {name: head.points({name: 1.0}) for name in expressions(head) if name.endswith("er")})


def check(mouth: Sheet, posed: dict[str, np.ndarray]) -> None:
    """No pose has more teeth before the lips than a shape alone may have."""
    found = {name: mouth.before_skin(points) for name, points in posed.items()}
    assert {name for name, one in found.items() if one.cells > SINGLE[0] or one.depth > SINGLE[1]} == set()


@pytest.mark.slow
def test_few_combinations_bring_teeth_through_lips(average: Subject, mouth: Sheet) -> None:
    drawn = list(draw_combinations(expressions(average), 60))
    over = []
    for seed, own in enumerate(np.array_split(np.array(drawn, object), 3), 1):
        subject = person(seed)
        found = [mouth.before_skin(subject.points(weights)) for weights in own]
        over += [one.cells > COMBINED[0] or one.depth > COMBINED[1] for one in found]
    assert np.mean(over) <= 0.02
