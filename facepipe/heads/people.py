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
from functools import cache

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
}
_WHITE: Color = (0.62, 0.60, 0.56)  # of hairs without pigment
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
        """(3,) linear, in the mean over the hairs: pigment pales before it goes, else red hair turns pink."""
        pigment = np.array(HAIR[self.hair])
        pigment = pigment + self.grey * (pigment.mean() - pigment)
        return np.asarray(pigment * (1 - self.grey) + np.array(_WHITE) * self.grey)

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
_WIDTHS = (1.7, 1.5)  # of weights, in standard deviations of the first mode, and of the last, which holds details
_MOST = 2.8  # standard deviations of a measure
_BACK = 2.75  # to which one beyond is taken
_MOST_OF_REGION = 1.9  # the same of the root mean square over a region's measures
_MOST_OF_EYES = 1.5  # lids follow eyeballs where sliders of eyes are at their ends, too
_BACK_OF_REGION = 0.97  # of that, to which one beyond is taken
YOUNGEST, OLDEST = 18.0, 80.0  # years
_FEWER_OLD = 1.6  # the exponent of an even draw between the two
_TYPICAL = 1.2  # the sex of whom `feminine` is at an end
_APART = 2.1  # standard deviations along the sculpts' difference of the sexes for 1 of it: half of it
_RIDGE = 0.05  # of squared effects: directions that hardly change what is asked for are left
_AGED = 1.4  # of half the sculpts' difference, that the youngest and the oldest are apart from the middle
_STEP = 1 / 2048  # of packed weights
_EFFECT = 1 / 16384  # of a measure's standard deviation: step of what modes do to it

# Standard deviations of the measures of whom `feminine` makes typical, women's; men's are the opposite. The sculpts of
# the trait differ in size, and not in brows, lips and lids. Signs are Farkas's (Anthropometry of the Head and Face,
# 1994) and, for brows and forehead, those of skulls; how much is set by eye and by what a network reads.
_WOMEN = {
    "browDepth": -1.8,
    "glabella": -1.4,
    "browHeight": 1.4,
    "browTilt": 0.4,
    "foreheadSlope": 1.0,
    "foreheadRound": 0.7,
    "eyeOpening": 1.1,
    "eyeTilt": 0.7,
    "noseWidth": -1.5,
    "noseTipWidth": -1.1,
    "noseRoot": 1.1,
    "noseBridge": -1.1,
    "noseTipHeight": 0.6,
    "nostrilBase": 0.0,
    "cheekFullness": 1.1,
    "upperLipFullness": 1.2,
    "lowerLipFullness": 1.2,
    "mouthWidth": -0.7,
    "philtrumLength": -1.1,
    "mouthCorner": 0.7,
    "jawWidth": -2.1,
    "jawLineWidth": -2.0,
    "chinWidth": -2.0,
    "chinLength": -2.0,
    "chinDepth": -0.7,
    "neckWidth": -2.2,
    "neckDepth": -1.8,
}

# Measures that dlib's recogniser tells people of one sex apart by. Of 40 people it takes 12.8 % of pairs for one
# person's, and 17 differ from one another, where first modes are drawn 1.3 times as wide and sexes are less apart;
# 10.1 % and 19 where first modes are 1.7 times as wide; 7.4 % and 22 with these measures farther and the sexes as here.
_TOLD_APART = (
    "noseWidth", "nostrilWidth", "noseRoot", "noseLength", "mouthWidth", "upperLipFullness", "lowerLipFullness",
    "eyeSpacing", "browHeight",
)  # fmt: skip
_FARTHER = 1.5  # times

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
    "bald": (0.0, 0.06),
    "stubble": (0.0, 0.07),
    "buzz": (0.0, 0.15),
    "crop": (0.01, 0.24),
    "parted": (0.01, 0.14),
    "slick": (0.005, 0.08),
    "fringe": (0.22, 0.01),
    "bob": (0.28, 0.02),
    "long": (0.32, 0.04),
    "bun": (0.04, 0.02),
    "ponytail": (0.05, 0.01),
    "coils": (0.01, 0.03),
    "afro": (0.04, 0.01),
}
_BEARDS = {"stubble": 0.5, "moustache": 0.1, "goatee": 0.15, "full": 0.25}  # share of men
_SHAVEN = 0.15  # how much a man's beard shows at least
_BROWS = {  # share of women and of men
    "soft": (0.4, 0.4),
    "arched": (0.45, 0.02),
    "straight": (0.0, 0.48),
}
_CURLED = ("coils", "afro")
_RECEDES = (0.01, 0.4)  # share of men whose hairline has receded at the youngest and at the oldest
_GREYING = 0.4  # share of the oldest who show it: the others colour their hair
_FIRST_GREY = (26.0, 58.0)  # years at which hairs begin to turn, of the first and of the last of those who show it
_TURNING = 25.0  # years until all have
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
    sex = float((1.0 if male else -1.0) * np.clip(random.normal(1.05, 0.3), 0.2, 1.6))
    drawn = float(YOUNGEST + (OLDEST - YOUNGEST) * random.random() ** _FEWER_OLD)
    spread = np.linspace(*_WIDTHS, MODES) * np.clip(random.standard_normal(MODES), -_FARTHEST, _FARTHEST)
    told_apart = _effects(_TOLD_APART)
    weights = _towards(spread, told_apart, _FARTHER * told_apart @ spread)
    average = seed == 0 and years is None
    if seed == 0:
        sex, drawn, weights = 0.0, Person.years, np.zeros(MODES)
    if feminine is not None:
        sex = _TYPICAL * (1.0 - 2.0 * feminine)
    manly, old = _manly(), arrays("measures")["trait_weights"][1] * _STEP
    across = manly / np.linalg.norm(manly)
    lived = drawn if years is None else years
    age = (lived - YOUNGEST) / (OLDEST - YOUNGEST)
    identity = weights + sex * manly - (weights @ across) * across
    identity += (0.0 if average else _AGED * (2.0 * age - 1.0)) * old
    look = Look() if average and feminine is None else _look(random, seed, sex, lived, dyed=years is None)
    return Person(identity=_within(identity), sex=sex, years=lived, look=look)


@cache
def _manly() -> FloatArray:
    """(MODES,) weights that 1 of sex adds: the sculpts', with the least change that measures ask for."""
    sculpts = arrays("measures")["trait_weights"][0] * _STEP
    typical = -np.array(list(_WOMEN.values())) / _TYPICAL
    return _towards(_APART * sculpts / np.linalg.norm(sculpts), _effects(tuple(_WOMEN)), typical)


@cache
def _effects(names: tuple[str, ...]) -> FloatArray:
    """(m, MODES) what 1 of each mode adds to measures, in standard deviations of these."""
    data = arrays("measures")
    numbers = {str(name): number for number, name in enumerate(data["names"])}
    return np.asarray(data["effects"][[numbers[name] for name in names]] * _EFFECT)


def _towards(weights: FloatArray, effects: FloatArray, values: FloatArray) -> FloatArray:
    """(MODES,) `weights` with the least change that brings measures (m,) near `values`, in standard deviations."""
    short = values - effects @ weights
    return np.asarray(weights + effects.T @ np.linalg.solve(effects @ effects.T + _RIDGE * np.eye(len(effects)), short))


def _within(identity: FloatArray) -> FloatArray:
    """(MODES,) weights changed as little as need be: no measure beyond `_MOST`, no region far in most of its own.

    Kaczmarz's projections, what is farthest first: rows of effects are unit vectors, and the length of a region's
    measures falls fastest along their sum, each times its row. Regions of many far measures make caricatures: a mouth
    small, thin and drawn down at once is within each measure's limit.
    """
    data = arrays("measures")
    effects = data["effects"] * _EFFECT
    parts = [(np.array([row]), _MOST, _BACK) for row in range(len(effects))]
    for region in dict.fromkeys(data["groups"].tolist()):
        rows = np.flatnonzero(data["groups"] == region)
        most = len(rows) ** 0.5 * (_MOST_OF_EYES if region == "eyes" else _MOST_OF_REGION)
        parts.append((rows, most, _BACK_OF_REGION * most))
    while True:
        values = effects @ identity
        rows, most, back = max(parts, key=lambda part: np.linalg.norm(values[part[0]]) / part[1])
        length = float(np.linalg.norm(values[rows]))
        if length <= most:
            return np.asarray(identity)
        way = values[rows] @ effects[rows]
        identity = identity - (1.0 - back / length) * length**2 / (way @ way) * way


def _look(random: np.random.Generator, seed: int, sex: float, years: float, *, dyed: bool) -> Look:
    """Colours and signs of a person of a sex and an age.

    :param dyed: some of the old colour their hair
    """
    tone, as_man, age = float(random.uniform(1.0, TONES)), sex > 0, (years - YOUNGEST) / (OLDEST - YOUNGEST)
    hair = _pick(random, _at(_HAIR, tone))
    fair = {"dark": 1.0, "brown": 1.0}
    eyes = _pick(random, {name: share * fair.get(name, _FAIR[hair]) for name, share in _at(_EYES, tone).items()})
    turn = random.random() / (_GREYING if dyed else 1.0)  # beyond 1 colours it
    turned = (years - np.interp(turn, (0.0, 1.0), _FIRST_GREY)) / _TURNING if turn <= 1.0 else 0.0
    shares = {name: own[as_man] for name, own in _STYLES.items()}
    for curled in _CURLED:
        shares[curled] *= float(np.interp(tone, (_LIGHT, _MIDDLE, _DARK), _COILS))
    found = Look(
        seed=seed,
        tone=tone,
        eyes=eyes,
        hair=hair,
        grey=float(np.clip(turned, 0.0, 1.0)),
        style=_pick(random, shares),
        redness=float(random.uniform(0.2, 0.8)),
        lips=float(random.uniform(0.3, 0.7) - 0.25 * sex),
        age=age,
        feminine=float(np.clip(0.5 - 0.5 * sex / _TYPICAL, 0.0, 1.0)),
        freckles=float(random.random() if tone < _MIDDLE and random.random() < 0.3 else 0.0),
        beard=float(_SHAVEN + (1 - _SHAVEN) * random.beta(1.2, 1.2) if as_man else 0.0),
        brows=float(np.clip(random.normal(0.5 + 0.25 * sex, 0.18), 0.0, 1.0)),
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
