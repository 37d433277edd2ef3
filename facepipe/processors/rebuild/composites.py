"""Composites: which shapes, and how much of each, a scanned expression shows.

Names are ARKit's with sides as ICT-FaceKit writes them; `resolved` finds them as a face has them: ``mouthSmileLeft``,
``mouthSmile_L``, and ``browInnerUp`` for both of its sides. ``mouthClose`` corrects ``jawOpen``: it closes the lips of
an open jaw, and never goes without it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from facepipe.core.errors import InputError
from facepipe.core.names import suggestion

_SIDES = ("_L", "_R")


def _both(**weights: float) -> dict[str, float]:
    return {f"{name}{side}": weight for name, weight in weights.items() for side in _SIDES}


DEFAULT_COMPOSITES: dict[str, dict[str, float]] = {
    "jaw_open": {"jawOpen": 0.8},
    "jaw_open_lips_closed": {"jawOpen": 0.6, "mouthClose": 0.6},
    "jaw_forward": {"jawForward": 0.8},
    "smile": _both(mouthSmile=1.0, cheekSquint=0.6),
    "laugh": {"jawOpen": 0.5, **_both(mouthSmile=0.8, cheekSquint=0.8, eyeSquint=0.6)},
    "brows_up": _both(browInnerUp=1.0, browOuterUp=0.9, eyeWide=0.8),
    "anger": _both(browDown=1.0, noseSneer=0.7, mouthPress=0.5),
    "closed_eyes": _both(eyeBlink=1.0),
    "squint": _both(eyeSquint=1.0, cheekSquint=0.9),
    "pucker": {"mouthPucker": 1.0},
    "funnel": {"mouthFunnel": 1.0, "jawOpen": 0.3},
    "sad": {"mouthShrugLower": 0.6, **_both(mouthFrown=1.0, browInnerUp=0.7)},
    "left": {"mouthLeft": 0.9, "jawLeft": 0.8, "eyeBlink_L": 0.7},
    "right": {"mouthRight": 0.9, "jawRight": 0.8, "eyeBlink_R": 0.7},
    "teeth": _both(mouthUpperUp=0.9, mouthLowerDown=0.9),
    "stretch": {"jawOpen": 0.4, **_both(mouthStretch=1.0, mouthDimple=0.5)},
    "rolled": {"mouthRollUpper": 0.9, "mouthRollLower": 0.9, "jawForward": 0.6, "mouthShrugUpper": 0.4},
    "cheeks_puffed": _both(cheekPuff=1.0),
    "look_up": _both(eyeLookUp=1.0),
    "look_down": _both(eyeLookDown=1.0),
}
"""Scanned expression -> shapes and their weights, where a project does not say."""


def resolved(composite: Mapping[str, float], shapes: Sequence[str], where: str) -> dict[str, float]:
    """The weights of a composite by the names that a face's `shapes` have, in their order.

    :raises InputError: no weight, one out of 0 to 2, or a shape that the face has not
    """
    if not composite:
        raise InputError(where, "names no shape, expected a weight for each shape that it shows")
    known = set(shapes)
    weights: dict[str, float] = {}
    for name, weight in composite.items():
        if not 0.0 < weight <= 2.0:
            raise InputError(f"{where} -> {name}", f"weight {weight}, expected one above 0, up to 2")
        shape = next((each for each in _spellings(name) if each in known), None)
        if shape is None:
            raise InputError(f"{where} -> {name}", f"no such shape{suggestion(name, shapes)}")
        weights[shape] = max(weight, weights.get(shape, 0.0))
    return {name: weights[name] for name in shapes if name in weights}


def _spellings(name: str) -> tuple[str, ...]:
    """A name as it is, with the other way to write its side, and without."""
    for short, long in (("_L", "Left"), ("_R", "Right")):
        for end, other in ((short, long), (long, short)):
            if name.endswith(end) and name != end:
                stem = name.removesuffix(end)
                return (name, stem + other, stem)
    return (name,)
