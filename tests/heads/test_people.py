"""People that seeds draw: always the same, of both sexes, all ages and all tones, with hair and eyes that go along."""

from __future__ import annotations

import numpy as np
import pytest
from places import REPOSITORY

from facepipe.core.arrays import FloatArray
from facepipe.heads.asset import arrays
from facepipe.heads.people import BROWS, HAIR, MODES, STYLES, Person, draw


@pytest.fixture(scope="module")
def people() -> list[Person]:
    return [draw(seed) for seed in range(1, 801)]


def test_no_measure_is_beyond_what_is_human(people: list[Person]) -> None:
    """2.8 standard deviations of the scans, at either age and sex too."""
    effects = arrays("measures")["effects"] / 16384
    np.testing.assert_allclose(np.linalg.norm(effects, axis=1), 1.0, atol=1e-3)
    drawn = [*people, *(draw(seed, years=80.0, feminine=seed % 2) for seed in range(1, 101))]
    assert np.abs(np.stack([person.identity for person in drawn]) @ effects.T).max() <= 2.8


def test_seed_0_is_the_average_head() -> None:
    assert not draw(0).identity.any()


def test_a_seed_draws_the_same_person_again(people: list[Person]) -> None:
    again = draw(5)
    np.testing.assert_array_equal(again.identity, people[4].identity)
    assert again.look == people[4].look


def test_a_person_is_the_same_at_every_age_but_for_what_is_typical_of_age() -> None:
    """Neutrals move along one direction but for what keeps measures human; colours that one is born with stay."""
    young, middle, old = (draw(5, years=years) for years in (20.0, 50.0, 80.0))
    for seed in range(1, 21):
        older, younger = (draw(seed, years=years).identity for years in (80.0, 20.0))
        assert _along(older - younger, arrays("measures")["trait_weights"][1]) > 0.8
        assert np.linalg.norm(older - younger) > 1
    assert young.look.worn == 0 < middle.look.worn < old.look.worn
    for name in ("tone", "eyes", "redness", "brow_shape"):
        assert getattr(young.look, name) == getattr(old.look, name)


def test_as_many_grey_as_years_pass_where_an_age_is_asked_for() -> None:
    """Nobody colours the hair then: none of the young, nearly all of the old."""
    shares = [
        np.mean([_is_grey(draw(seed, years=years)) for seed in range(1, 101)]) for years in (25.0, 45.0, 60.0, 78.0)
    ]
    assert shares[0] == 0
    assert shares[0] < shares[1] < shares[2] < shares[3]
    assert shares[3] > 0.95


def test_hairs_turn_grey_one_by_one() -> None:
    """No one's hair changes by more than a twentieth from a year to the next, and none turns back."""
    for seed in range(1, 41):
        shares = [draw(seed, years=years).look.grey for years in range(18, 81)]
        assert shares[0] == 0
        assert all(0 <= step <= 0.05 for step in np.diff(shares))


def test_sex_is_as_asked_for() -> None:
    """Shapes move along one direction with `feminine`; all else stays but for what keeps measures human."""
    woman, man = (draw(7, feminine=value) for value in (1.0, 0.0))
    ways = [draw(seed, feminine=0.0).identity - draw(seed, feminine=1.0).identity for seed in range(1, 41)]
    typical = np.mean(ways, axis=0)
    assert min(_along(way, typical) for way in ways) > 0.8
    assert woman.sex == -man.sex < 0
    assert woman.look.beard == 0 < man.look.beard
    women, men = ([draw(seed, feminine=value).look for seed in range(1, 101)] for value in (1.0, 0.0))
    assert np.mean([look.brows for look in women]) < np.mean([look.brows for look in men])
    assert np.mean([look.brow_shape == "arched" for look in women]) > 0.3
    assert {look.whiskers for look in women} == {"stubble"}


LARGER = {
    "male": ("jawWidth", "chinLength", "noseWidth", "browDepth", "neckWidth", "faceWidth"),
    "female": ("browHeight", "eyeOpening", "upperLipFullness", "lowerLipFullness"),
}


def test_measures_of_the_sexes_are_apart() -> None:
    """A standard deviation in the mean, as anthropometry has them: men's jaws, chins, noses, brow ridges and necks are
    larger, women's lips fuller, lids wider open and brows higher above them."""
    data = arrays("measures")
    ways = [draw(seed, feminine=0.0).identity - draw(seed, feminine=1.0).identity for seed in range(1, 41)]
    apart = dict(zip(data["names"].tolist(), (data["effects"] / 16384) @ np.mean(ways, axis=0), strict=True))
    assert min(apart[name] for name in LARGER["male"]) > 1.0
    assert max(apart[name] for name in LARGER["female"]) < -1.0


def test_no_region_is_far_in_all_its_measures(people: list[Person]) -> None:
    """The root mean square over a region's measures: a mouth small, thin and drawn down at once is a caricature.

    Eyes less than others: lids follow eyeballs with their sliders at the ends, too.
    """
    data = arrays("measures")
    values = np.stack([person.identity for person in people]) @ (data["effects"] / 16384).T
    for region in set(data["groups"].tolist()):
        most = 1.5 if region == "eyes" else 1.9
        assert np.sqrt((values[:, data["groups"] == region] ** 2).mean(axis=1)).max() <= most


def test_hairlines_recede_with_the_years() -> None:
    receding = [
        sum(draw(seed, years=years, feminine=0.0).look.style == "receding" for seed in range(1, 201))
        for years in (20, 50, 80)
    ]
    assert receding[0] < receding[1] < receding[2]
    assert not any(draw(seed, years=80, feminine=1.0).look.style == "receding" for seed in range(1, 101))


def _along(way: FloatArray, direction: FloatArray) -> float:
    return float(way @ direction / np.linalg.norm(way) / np.linalg.norm(direction))


def test_shapes_are_wider_than_the_statistics_of_the_modes(people: list[Person]) -> None:
    """Half again as wide, the first, which change a face most, and those of details alike.

    But for what goes with sex and what tells people apart, modes are drawn by themselves.
    """
    weights = np.stack([person.identity for person in people])
    assert weights.shape == (800, MODES)
    assert np.abs(weights.mean(axis=0)).max() < 0.3
    widths = weights.std(axis=0)
    assert 1.4 < widths[:10].mean() < 1.6
    assert 1.4 < widths[-20:].mean() < 1.6
    sexes = np.array([[person.sex] for person in people])
    weights = weights - sexes @ np.linalg.lstsq(sexes, weights, rcond=None)[0]
    assert np.abs(np.corrcoef(weights.T) - np.eye(MODES)).max() < 0.3


def test_tones_sexes_and_ages_are_all_there(people: list[Person]) -> None:
    tones = np.array([person.look.tone for person in people])
    assert (np.bincount(np.rint(tones).astype(int), minlength=11)[1:] > 20).all()
    assert 0.4 < np.mean([person.sex > 0 for person in people]) < 0.6
    assert np.ptp([person.years for person in people]) > 55
    pictures = REPOSITORY / "facepipe" / "heads" / "data"
    eyes = {path.stem.removeprefix("iris_") for path in pictures.glob("iris_*.jpg")}
    for own, names in (("hair", HAIR), ("eyes", eyes), ("style", STYLES), ("brow_shape", BROWS)):
        assert {getattr(person.look, own) for person in people} == set(names)


def test_hair_and_eyes_go_with_the_tone(people: list[Person]) -> None:
    dark = [person.look for person in people if person.look.tone >= 7.0]
    assert {look.eyes for look in dark} <= {"dark", "brown"}
    assert {look.hair for look in dark} <= {"black", "dark"}
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
    return person.look.grey > 0.5
