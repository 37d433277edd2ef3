"""Teeth of drawn people stay behind their lips, whatever expressions come together."""

from __future__ import annotations

import numpy as np
import pytest
from contacts import COMBINED, SINGLE, draw_combinations, expressions, mouth_sheet, person

PEOPLE = ((0, ""), (14, "er"), (18, "er"), (23, "er"), (24, "er"))


@pytest.mark.parametrize(
    ("seed", "ending"), [(2, "er"), *(pytest.param(*case, marks=pytest.mark.slow) for case in PEOPLE)]
)
def test_no_shape_brings_teeth_through_lips(seed: int, ending: str) -> None:
    """All shapes of the average head; of other people those that roll a lip, which are the worst."""
    head = person(seed)
    mouth = mouth_sheet(person(0))
    names = [name for name in expressions(head) if name.endswith(ending)]
    found = {name: mouth.before_skin(head.points({name: 1.0})) for name in names}
    assert {name for name, one in found.items() if one.cells > SINGLE[0] or one.depth > SINGLE[1]} == set()


@pytest.mark.slow
def test_few_combinations_bring_teeth_through_lips() -> None:
    average = person(0)
    mouth, drawn = mouth_sheet(average), list(draw_combinations(expressions(average), 60))
    over = []
    for seed, own in enumerate(np.array_split(np.array(drawn, object), 3), 1):
        subject = person(seed)
        found = [mouth.before_skin(subject.points(weights)) for weights in own]
        over += [one.cells > COMBINED[0] or one.depth > COMBINED[1] for one in found]
    assert np.mean(over) <= 0.02
