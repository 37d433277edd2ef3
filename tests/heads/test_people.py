"""People that seeds draw: always the same, of both sexes, all ages and all tones, with hair and eyes that go along."""

from __future__ import annotations

import numpy as np
import pytest
from places import REPOSITORY

from facepipe.heads.people import HAIR, MODES, STYLES, Person, draw


@pytest.fixture(scope="module")
def people() -> list[Person]:
    return [draw(seed) for seed in range(1, 801)]


def test_seed_0_is_the_average_head() -> None:
    assert not draw(0).identity.any()


def test_a_seed_draws_the_same_person_again(people: list[Person]) -> None:
    again = draw(5)
    np.testing.assert_array_equal(again.identity, people[4].identity)
    assert again.look == people[4].look


def test_shapes_have_the_statistics_of_the_modes(people: list[Person]) -> None:
    weights = np.stack([person.identity for person in people])
    assert weights.shape == (800, MODES)
    assert np.abs(weights.mean(axis=0)).max() < 0.2
    assert np.abs(weights.std(axis=0) - 1).mean() < 0.1
    assert np.abs(np.corrcoef(weights.T) - np.eye(MODES)).max() < 0.25


def test_tones_sexes_and_ages_are_all_there(people: list[Person]) -> None:
    tones = np.array([person.look.tone for person in people])
    assert (np.bincount(np.rint(tones).astype(int), minlength=11)[1:] > 20).all()
    assert 0.4 < np.mean([person.sex > 0 for person in people]) < 0.6
    assert np.ptp([person.years for person in people]) > 55
    pictures = REPOSITORY / "facepipe" / "heads" / "data"
    eyes = {path.stem.removeprefix("iris_") for path in pictures.glob("iris_*.jpg")}
    for own, names in (("hair", HAIR), ("eyes", eyes), ("style", STYLES)):
        assert {getattr(person.look, own) for person in people} == set(names)


def test_hair_and_eyes_go_with_the_tone(people: list[Person]) -> None:
    dark = [person.look for person in people if person.look.tone >= 7.0]
    assert {look.eyes for look in dark} <= {"dark", "brown"}
    assert {look.hair for look in dark} <= {"black", "dark", "grey", "white"}
    assert np.mean([_is_grey(person) for person in people if person.years < 30]) < 0.05
    assert not any(person.look.beard for person in people if person.sex < 0)


def test_some_of_the_old_are_grey_and_few_of_the_others(people: list[Person]) -> None:
    grey, old = (
        np.array(each) for each in zip(*((_is_grey(person), person.years > 55) for person in people), strict=True)
    )
    assert 0.25 < grey[old].mean() < 0.5
    assert grey[~old].mean() < 0.1
    assert 4 <= sum(_is_grey(draw(seed)) for seed in range(1, 51)) <= 7


def _is_grey(person: Person) -> bool:
    return person.look.hair in ("grey", "white")
