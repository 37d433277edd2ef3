"""What is measured on a face: places, and signed distances between them along the axes of the head.

Lengths are in centimetres on the average head of ICT-FaceKit; a place is on the left side or in the middle, and every
measure takes the mean of both sides. Names of places follow anthropometry where it has one (Farkas, Anthropometry of
the Head and Face, 1994).
"""

from __future__ import annotations

from dataclasses import dataclass, field

Spot = int | tuple[float, float, float]  # of multipie68, or near a point of the skin

FINE, BROAD, WIDE = 0.2, 0.5, 1.2  # cm: a place is the mean of the skin around it, by a Gaussian of that width

SPOTS: dict[str, tuple[Spot, float]] = {
    "alare": ((2.0, -0.5, 10.3), FINE),
    "alarBase": ((1.6, -1.15, 10.4), FINE),
    "alarTop": ((1.5, 0.5, 11.0), FINE),
    "nostril": (35, FINE),
    "pronasale": ((0.0, 0.3, 13.1), FINE),
    "tipSide": ((0.8, 0.2, 12.5), FINE),
    "nasion": ((0.0, 3.9, 10.65), FINE),
    "dorsum": ((0.0, 2.2, 11.8), FINE),
    "bridgeSide": ((0.85, 2.0, 11.0), FINE),
    "subnasale": ((0.0, -1.2, 11.55), FINE),
    "endocanthion": (42, FINE),
    "exocanthion": (45, FINE),
    "upperLidInner": (43, FINE),
    "upperLidOuter": (44, FINE),
    "lowerLidInner": (47, FINE),
    "lowerLidOuter": (46, FINE),
    "browInner": (22, FINE),
    "browPeakInner": (23, FINE),
    "browPeakOuter": (24, FINE),
    "browOuter": (26, FINE),
    "glabella": ((0.0, 5.6, 10.8), FINE),
    "trichion": ((0.0, 9.8, 9.5), WIDE),
    "midForehead": ((0.0, 7.7, 10.3), WIDE),
    "frontotemporale": ((5.6, 7.6, 7.4), WIDE),
    "vertex": ((0.0, 14.5, 0.0), WIDE),
    "opisthocranion": ((0.0, 5.5, -8.7), WIDE),
    "euryon": ((7.85, 7.3, -0.7), WIDE),
    "zygion": ((7.2, 1.2, 4.4), FINE),
    "malare": ((5.0, 0.6, 9.0), BROAD),
    "cheek": ((4.6, -2.6, 8.6), BROAD),
    "gonion": ((5.95, -4.6, 4.4), BROAD),
    "jawMiddle": ((4.3, -6.2, 7.3), BROAD),
    "menton": ((0.0, -8.05, 9.3), FINE),
    "pogonion": ((0.0, -6.4, 11.0), FINE),
    "sublabiale": ((0.0, -5.0, 10.9), FINE),
    "chinSide": ((1.85, -7.05, 10.15), FINE),
    "underChin": ((0.0, -8.5, 6.6), FINE),
    "cheilion": (54, FINE),
    "labialeSuperius": (51, FINE),
    "cupidPeak": (52, FINE),
    "stomionUpper": (62, FINE),
    "stomionLower": (66, FINE),
    "labialeInferius": (57, FINE),
    "upperLipMiddle": ((0.0, -2.85, 11.8), FINE),
    "lowerLipMiddle": ((0.0, -3.95, 11.6), FINE),
    "tragion": ((7.3, 1.5, 3.1), FINE),
    "superaurale": ((7.9, 5.5, -0.15), FINE),
    "subaurale": ((7.6, -1.65, 0.25), FINE),
    "helix": ((9.15, 2.9, -1.1), FINE),
    "preaurale": ((7.3, 2.6, 3.0), FINE),
    "postaurale": ((8.85, 2.5, -1.6), FINE),
    "neckSide": ((5.6, -9.6, 0.4), BROAD),
    "neckFront": ((0.0, -11.0, 4.7), BROAD),
    "neckBack": ((0.0, -9.75, -6.6), BROAD),
}


@dataclass(frozen=True)
class Measure:
    """A signed distance: sums of places, each times a share, along x, y and z."""

    group: str
    x: dict[str, float] = field(default_factory=dict)
    y: dict[str, float] = field(default_factory=dict)
    z: dict[str, float] = field(default_factory=dict)
    sided: bool = False  # left and right have sliders of their own


def _between(first: str, second: str) -> dict[str, float]:
    return {first: 1.0, second: -1.0}


_EYE = {"endocanthion": 0.5, "exocanthion": 0.5}
_LESS_EYE = {name: -share for name, share in _EYE.items()}
_LESS_FACE = dict.fromkeys(("endocanthion", "exocanthion", "alarBase", "cheilion"), -0.25)
_PEAK = {"browPeakInner": 0.5, "browPeakOuter": 0.5}
_BROW = dict.fromkeys(("browInner", "browPeakInner", "browPeakOuter", "browOuter"), 0.25)
_LIDS = {"upperLidInner": 0.5, "upperLidOuter": 0.5}

MEASURES: dict[str, Measure] = {
    "noseWidth": Measure("nose", x={"alare": 2.0}),
    "noseLength": Measure("nose", y=_between("nasion", "subnasale")),
    "noseDepth": Measure("nose", z=_between("pronasale", "alarBase")),
    "noseBridge": Measure("nose", z={"dorsum": 1.0, "nasion": -0.5, "pronasale": -0.5}),
    "noseRoot": Measure("nose", z=_between("nasion", "glabella")),
    "noseBridgeWidth": Measure("nose", x={"bridgeSide": 2.0}),
    "noseTipWidth": Measure("nose", x={"tipSide": 2.0}),
    "noseTipHeight": Measure("nose", y=_between("pronasale", "subnasale")),
    "nostrilWidth": Measure("nose", x={"nostril": 2.0}),
    "nostrilHeight": Measure("nose", y=_between("alarTop", "alarBase"), sided=True),
    "nostrilBase": Measure("nose", y=_between("alarBase", "subnasale"), sided=True),
    "eyeSpacing": Measure("eyes", x={"endocanthion": 2.0}),
    "eyeWidth": Measure("eyes", x=_between("exocanthion", "endocanthion"), sided=True),
    "eyeOpening": Measure("eyes", y=_LIDS | {"lowerLidInner": -0.5, "lowerLidOuter": -0.5}, sided=True),
    "eyeTilt": Measure("eyes", y=_between("exocanthion", "endocanthion"), sided=True),
    "eyeHeight": Measure("eyes", y=_EYE, sided=True),
    "eyeDepth": Measure("eyes", z=_EYE, sided=True),
    "browHeight": Measure("brows", y=_PEAK | _LESS_EYE, sided=True),
    "browDepth": Measure("brows", z=_BROW | _LESS_FACE, sided=True),
    "browTilt": Measure("brows", y=_between("browOuter", "browInner"), sided=True),
    "glabella": Measure("brows", z=_between("glabella", "browPeakInner")),
    "foreheadHeight": Measure("forehead", y=_between("trichion", "glabella")),
    "foreheadSlope": Measure("forehead", z=_between("trichion", "glabella")),
    "foreheadRound": Measure("forehead", z={"midForehead": 1.0, "trichion": -0.5, "glabella": -0.5}),
    "foreheadWidth": Measure("forehead", x={"frontotemporale": 2.0}),
    "headLength": Measure("head", z=_between("glabella", "opisthocranion")),
    "headWidth": Measure("head", x={"euryon": 2.0}),
    "headHeight": Measure("head", y=_between("vertex", "tragion")),
    "faceWidth": Measure("cheeks", x={"zygion": 2.0}),
    "cheekboneWidth": Measure("cheeks", x={"malare": 2.0}, sided=True),
    "cheekboneHeight": Measure("cheeks", y=_between("malare", "tragion"), sided=True),
    "cheekboneDepth": Measure("cheeks", z={"malare": 1.0} | _LESS_FACE, sided=True),
    "cheekFullness": Measure(
        "cheeks", x={"cheek": 0.6}, z={"cheek": 0.8, "malare": -0.4, "chinSide": -0.4}, sided=True
    ),
    "jawWidth": Measure("jaw", x={"gonion": 2.0}, sided=True),
    "jawAngleHeight": Measure("jaw", y=_between("gonion", "tragion"), sided=True),
    "jawLineWidth": Measure("jaw", x={"jawMiddle": 2.0}, sided=True),
    "chinLength": Measure("jaw", y=_between("stomionLower", "menton")),
    "chinDepth": Measure("jaw", z={"pogonion": 1.0} | _LESS_FACE),
    "chinWidth": Measure("jaw", x={"chinSide": 2.0}),
    "chinFold": Measure("jaw", z={"sublabiale": 1.0, "pogonion": -0.5, "labialeInferius": -0.5}),
    "underChin": Measure("jaw", y=_between("underChin", "menton")),
    "mouthWidth": Measure("mouth", x={"cheilion": 2.0}),
    "philtrumLength": Measure("mouth", y=_between("subnasale", "labialeSuperius")),
    "upperLipFullness": Measure("mouth", y=_between("labialeSuperius", "stomionUpper")),
    "lowerLipFullness": Measure("mouth", y=_between("stomionLower", "labialeInferius")),
    "upperLipDepth": Measure("mouth", z=_between("upperLipMiddle", "subnasale")),
    "lowerLipDepth": Measure("mouth", z=_between("lowerLipMiddle", "upperLipMiddle")),
    "mouthCorner": Measure("mouth", y={"cheilion": 1.0, "stomionUpper": -0.5, "stomionLower": -0.5}, sided=True),
    "cupidsBow": Measure("mouth", y=_between("cupidPeak", "labialeSuperius")),
    "earHeight": Measure("ears", y={"superaurale": 0.5, "subaurale": 0.5, "tragion": -1.0}, sided=True),
    "earLength": Measure("ears", y=_between("superaurale", "subaurale"), sided=True),
    "earAngle": Measure("ears", x=_between("helix", "tragion"), sided=True),
    "earWidth": Measure("ears", z=_between("preaurale", "postaurale"), sided=True),
    "neckWidth": Measure("neck", x={"neckSide": 2.0}),
    "neckDepth": Measure("neck", z=_between("neckFront", "neckBack")),
}
