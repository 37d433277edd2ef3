"""Who a seed draws: the shape of a head, its sex and age, and the colours that go with one another.

Shapes go beyond the statistics of ICT-FaceKit's identity modes, whose scans are few: independent normal weights, wider
than theirs, of which the one along the typical difference between the sexes is drawn with the sex. Age is added, and
what takes a measure of the face beyond what is human is taken back. Skin tones are even on Monk's scale of ten (Ellis
Monk, "The Monk Skin Tone Scale", 2019, skintone.google). How often a colour of hair or eyes comes with a tone is made
up to be plausible: no survey is in it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.heads.asset import arrays
from facepipe.parts import Color

# Albedo of Monk's ten tones under even light, sRGB 0..255: the swatches show lit skin, which is lighter.
_TONES = (
    (229, 188, 170), (225, 181, 160), (219, 174, 147), (209, 161, 131), (193, 143, 111),
    (165, 116, 83), (137, 92, 66), (109, 70, 48), (88, 54, 36), (70, 42, 28),
)  # fmt: skip

IRIS: dict[str, Color] = {  # linear, of its middle ring
    "dark": (0.030, 0.014, 0.008),
    "brown": (0.085, 0.037, 0.014),
    "hazel": (0.095, 0.055, 0.018),
    "green": (0.075, 0.092, 0.042),
    "grey": (0.11, 0.13, 0.145),
    "blue": (0.062, 0.11, 0.17),
}
HAIR: dict[str, Color] = {  # linear
    "black": (0.012, 0.009, 0.008),
    "dark": (0.022, 0.013, 0.009),
    "brown": (0.055, 0.030, 0.016),
    "light": (0.13, 0.075, 0.036),
    "blond": (0.33, 0.21, 0.10),
    "red": (0.19, 0.050, 0.016),
    "grey": (0.30, 0.29, 0.28),
    "white": (0.62, 0.60, 0.56),
}
STYLES = {  # how much hair colours the scalp, and the picture that its cards show
    "bald": (0.0, ""),
    "stubble": (0.5, ""),
    "buzz": (0.8, "hair.png"),
    "crop": (0.95, "hair.png"),
    "receding": (0.85, "hair.png"),
    "parted": (0.95, "hair.png"),
    "slick": (0.95, "hair.png"),
    "fringe": (0.95, "hair.png"),
    "bob": (0.95, "hair.png"),
    "long": (0.95, "hair.png"),
    "bun": (0.95, "hair.png"),
    "ponytail": (0.95, "hair.png"),
    "coils": (0.97, "coils.png"),
    "afro": (0.97, "coils.png"),
}

BEARDS = {"stubble": 0.0, "moustache": 0.9, "goatee": 0.85, "full": 0.9}  # how much hair colours the skin below cards


BROWS = {  # pictures of their hairs, the fullest last
    "soft": ("brows0.png", "brows1.png", "brows2.png"),
    "arched": ("brows_arched.png",),
    "straight": ("brows_straight.png",),
}


@dataclass(frozen=True, kw_only=True)
class Look:
    """Colours and signs of one person; shares are 0..1."""

    seed: int = 0  # of what is placed by chance: mottling, pores, freckles, moles
    tone: float = 4.0  # Monk's scale, 1..10
    redness: float = 0.5  # blood in cheeks, nose and ears
    lips: float = 0.5  # colour of the lips
    age: float = 0.3  # 0 at 18 years, 1 at 80: lines, spots, veins, rough and uneven skin
    feminine: float = 0.5  # finer skin, darker rims of lids, redder lips
    freckles: float = 0.0
    beard: float = 0.0  # stubble and its shade
    brows: float = 0.5  # how full they are
    brow_shape: str = "soft"  # one of BROWS
    eyes: str = "brown"  # one of IRIS
    hair: str = "dark"  # one of HAIR
    grey: float = 0.0  # share of the hairs that have lost that colour
    style: str = "crop"  # one of STYLES
    whiskers: str = "stubble"  # one of BEARDS

    @property
    def hair_color(self) -> FloatArray:
        """(3,) linear, in the mean over the hairs."""
        return np.array(HAIR[self.hair]) * (1 - self.grey) + np.array(HAIR["grey"]) * self.grey

    @property
    def skin(self) -> FloatArray:
        """(3,) linear albedo."""
        tones = ((np.array(_TONES) / 255 + 0.055) / 1.055) ** 2.4
        return np.array([np.exp(np.interp(self.tone, np.arange(1, 11), np.log(tones[:, c]))) for c in range(3)])

    @property
    def darkness(self) -> float:
        """0 for the lightest skin, 1 for the darkest."""
        return float(np.clip((self.tone - 1) / 9, 0, 1))

    @property
    def worn(self) -> float:
        """How much years have left on the skin: 0 up to 25 years, 0.5 at 47, 1 from 75 on."""
        return float(np.clip((self.age - 0.12) / 0.8, 0, 1) ** 0.85)


MODES = 100
TONES = 10  # of Monk's scale
_FARTHEST = 2.5  # standard deviations of a drawn weight
_WIDTHS = (1.3, 1.7)  # of weights, in standard deviations of the first mode, and of the last, which holds details
_MOST = 2.8  # standard deviations of a measure
_BACK = 2.75  # to which one beyond is taken
YOUNGEST, OLDEST = 18.0, 80.0  # years
_FEWER_OLD = 1.6  # the exponent of an even draw between the two
_TYPICAL = 1.2  # the sex of whom `feminine` is at an end
_APART = 1.7  # standard deviations along the difference of the sexes for 1 of it; half the sculpts' difference is 2.1
_AGED = 1.4  # of half the sculpts' difference, that the youngest and the oldest are apart from the middle
_STEP = 1 / 2048  # of packed weights
_EFFECT = 1 / 16384  # of a measure's standard deviation: step of what modes do to it

_LIGHT, _MIDDLE, _DARK = 2.5, 5.0, 7.0  # tones between which the shares below are mixed
_HAIR = {  # share at those tones
    "black": (0.03, 0.35, 0.85),
    "dark": (0.20, 0.45, 0.15),
    "brown": (0.34, 0.18, 0.0),
    "light": (0.22, 0.02, 0.0),
    "blond": (0.15, 0.0, 0.0),
    "red": (0.06, 0.0, 0.0),
}
_EYES = {
    "dark": (0.03, 0.30, 0.70),
    "brown": (0.27, 0.55, 0.30),
    "hazel": (0.20, 0.12, 0.0),
    "green": (0.12, 0.02, 0.0),
    "blue": (0.28, 0.01, 0.0),
    "grey": (0.10, 0.0, 0.0),
}
_FAIR = {"black": 0.1, "dark": 0.5, "brown": 1.0, "light": 1.6, "blond": 2.5, "red": 1.6}  # times for fair eyes
_STYLES = {  # share of women and of men; hairlines recede by age
    "bald": (0.01, 0.06),
    "stubble": (0.01, 0.07),
    "buzz": (0.03, 0.15),
    "crop": (0.09, 0.24),
    "parted": (0.05, 0.14),
    "slick": (0.03, 0.08),
    "fringe": (0.14, 0.01),
    "bob": (0.17, 0.02),
    "long": (0.18, 0.04),
    "bun": (0.11, 0.02),
    "ponytail": (0.12, 0.01),
    "coils": (0.03, 0.03),
    "afro": (0.03, 0.01),
}
_BEARDS = {"stubble": 0.66, "moustache": 0.06, "goatee": 0.1, "full": 0.18}  # share of men
_SHAVEN = 0.15  # how much a man's beard shows at least
_BROWS = {  # share of women and of men
    "soft": (0.45, 0.5),
    "arched": (0.5, 0.02),
    "straight": (0.05, 0.48),
}
_CURLED = ("coils", "afro")
_RECEDES = (0.01, 0.4)  # share of men whose hairline has receded at the youngest and at the oldest
_GREYING = 0.4  # share of the oldest who show it: the others colour their hair
_PEPPER = (38.0, 75.0)  # years from which, and to which, hairs of those who let it grow turn grey one by one
_COILS = (0.2, 1.0, 5.0)  # times for curls at light, middle and dark tones


@dataclass(frozen=True, kw_only=True)
class Person:
    """One person."""

    identity: FloatArray  # (MODES,) weights of the identity modes, in standard deviations
    sex: float = 0.0  # about -1 typically female, 1 typically male
    years: float = 30.0
    look: Look


def draw(seed: int, *, years: float | None = None, feminine: float | None = None) -> Person:
    """The person of a seed; seed 0 is the average head. Same seed, same person, at every age too.

    :param years: 18 to 80; None: as drawn. Where they are given, nobody colours the hair
    :param feminine: 0 typically male, 1 typically female; None: as drawn
    """
    random = np.random.Generator(np.random.PCG64(seed))
    male = bool(random.random() < 0.5)
    sex = float((1.0 if male else -1.0) * np.clip(random.normal(0.9, 0.35), 0.0, 1.6))
    drawn = float(YOUNGEST + (OLDEST - YOUNGEST) * random.random() ** _FEWER_OLD)
    weights = np.linspace(*_WIDTHS, MODES) * np.clip(random.standard_normal(MODES), -_FARTHEST, _FARTHEST)
    average = seed == 0 and years is None
    if seed == 0:
        sex, drawn, weights = 0.0, Person.years, np.zeros(MODES)
    if feminine is not None:
        sex = _TYPICAL * (1.0 - 2.0 * feminine)
    by_sex, old = arrays("measures")["trait_weights"] * _STEP
    across = by_sex / np.linalg.norm(by_sex)
    lived = drawn if years is None else years
    age = (lived - YOUNGEST) / (OLDEST - YOUNGEST)
    identity = weights + (_APART * sex - weights @ across) * across
    identity += (0.0 if average else _AGED * (2.0 * age - 1.0)) * old
    look = Look() if average and feminine is None else _look(random, seed, sex, lived, dyed=years is None)
    return Person(identity=_within(identity), sex=sex, years=lived, look=look)


def _within(identity: FloatArray) -> FloatArray:
    """(MODES,) weights changed as little as need be so that no measure is beyond `_MOST`.

    Kaczmarz's projections, the farthest measure first: each row of effects is a unit vector.
    """
    effects = arrays("measures")["effects"] * _EFFECT
    while abs(values := effects @ identity).max() > _MOST:
        farthest = int(np.abs(values).argmax())
        identity = identity - (values[farthest] - np.sign(values[farthest]) * _BACK) * effects[farthest]
    return np.asarray(identity)


def _look(random: np.random.Generator, seed: int, sex: float, years: float, *, dyed: bool) -> Look:
    """Colours and signs of a person of a sex and an age.

    :param dyed: some of the old colour their hair
    """
    tone, as_man, age = float(random.uniform(1.0, TONES)), sex > 0, (years - YOUNGEST) / (OLDEST - YOUNGEST)
    hair = _pick(random, _at(_HAIR, tone))
    fair = {"dark": 1.0, "brown": 1.0}
    eyes = _pick(random, {name: share * fair.get(name, _FAIR[hair]) for name, share in _at(_EYES, tone).items()})
    shown, chance = _GREYING if dyed else 1.0, random.random()
    white, grey = shown / (1.0 + np.exp((np.array([72.0, 55.0]) - years) / 5.0))
    pepper = float(np.interp(years, _PEPPER, (0.0, 0.8))) * max(1.0 - chance / shown, 0.0)
    hair = "white" if chance < white else "grey" if chance < grey else hair
    shares = {name: own[as_man] for name, own in _STYLES.items()}
    for curled in _CURLED:
        shares[curled] *= float(np.interp(tone, (_LIGHT, _MIDDLE, _DARK), _COILS))
    found = Look(
        seed=seed,
        tone=tone,
        eyes=eyes,
        hair=hair,
        grey=0.0 if hair in ("grey", "white") else pepper,
        style=_pick(random, shares),
        redness=float(random.uniform(0.2, 0.8)),
        lips=float(random.uniform(0.3, 0.7) - 0.15 * sex),
        age=age,
        feminine=float(np.clip(0.5 - 0.5 * sex / _TYPICAL, 0.0, 1.0)),
        freckles=float(random.random() if tone < _MIDDLE and random.random() < 0.3 else 0.0),
        beard=float(_SHAVEN + (1 - _SHAVEN) * random.beta(1.2, 1.6) if as_man else 0.0),
        brows=float(np.clip(random.normal(0.5 + 0.15 * sex, 0.18), 0.0, 1.0)),
        whiskers=_pick(random, _BEARDS) if as_man else "stubble",
    )
    found = replace(found, brow_shape=_pick(random, {name: share[as_man] for name, share in _BROWS.items()}))
    recedes = as_man and random.random() < np.interp(years, (YOUNGEST, OLDEST), _RECEDES)
    return replace(found, style="receding") if recedes and STYLES[found.style][1] == "hair.png" else found


def _at(shares: Mapping[str, tuple[float, float, float]], tone: float) -> dict[str, float]:
    return {name: float(np.interp(tone, (_LIGHT, _MIDDLE, _DARK), own)) for name, own in shares.items()}


def _pick(random: np.random.Generator, shares: Mapping[str, float]) -> str:
    """One of the names, by their shares."""
    names, chances = list(shares), np.array(list(shares.values()))
    return names[int(np.searchsorted(np.cumsum(chances) / chances.sum(), random.random(), side="right"))]
