"""Sliders of expression: moods, where the eyes look, and the fifteen visemes of Oculus, all over shapes of ARKit."""

from __future__ import annotations

from facepipe.parts import Slider

_TURN = 0.5  # radians that an eye turns to the side, and up or down, at 1
_LEFT, _RIGHT = "root/neck/head/eyeLeft", "root/neck/head/eyeRight"
_RISING = ((-1.0, 0.0), (0.0, 0.0), (1.0, 1.0))
_FALLING = ((-1.0, 1.0), (0.0, 0.0), (1.0, 0.0))
_BOTH = ("Left", "Right")

_MOODS: dict[str, dict[str, float]] = {
    "smile": {"mouthSmile": 1.0, "cheekSquint": 0.5},
    "frown": {"mouthFrown": 1.0, "browInnerUp": 0.5},
    "blink": {"eyeBlink": 1.0},
    "mouthOpen": {"jawOpen": 1.0},
}
VISEMES: dict[str, dict[str, float]] = {
    "sil": {"mouthPress": 0.05},
    "PP": {"mouthPress": 0.5, "mouthRollLower": 0.3, "mouthRollUpper": 0.25, "mouthPucker": 0.1},
    "FF": {"jawOpen": 0.04, "mouthRollLower": 0.55, "mouthUpperUp": 0.3, "mouthShrugLower": 0.15},
    "TH": {"tongueOut": 0.72, "mouthLowerDown": 0.15, "mouthUpperUp": 0.1},
    "DD": {"jawOpen": 0.12, "mouthLowerDown": 0.3, "mouthUpperUp": 0.15},
    "kk": {"jawOpen": 0.2, "mouthStretch": 0.15, "mouthLowerDown": 0.15},
    "CH": {"jawOpen": 0.07, "mouthFunnel": 0.7, "mouthPucker": 0.2, "mouthShrugUpper": 0.15},
    "SS": {"jawOpen": 0.03, "mouthStretch": 0.35, "mouthSmile": 0.15, "mouthLowerDown": 0.4, "mouthUpperUp": 0.2},
    "nn": {"jawOpen": 0.09, "mouthLowerDown": 0.25, "mouthUpperUp": 0.1},
    "RR": {"jawOpen": 0.1, "mouthFunnel": 0.45, "mouthPucker": 0.2},
    "aa": {"jawOpen": 0.55, "mouthStretch": 0.1, "mouthLowerDown": 0.2},
    "E": {"jawOpen": 0.22, "mouthStretch": 0.35, "mouthSmile": 0.2, "mouthLowerDown": 0.2, "mouthUpperUp": 0.1},
    "I": {"jawOpen": 0.12, "mouthSmile": 0.5, "mouthStretch": 0.25, "mouthLowerDown": 0.25},
    "O": {"jawOpen": 0.4, "mouthFunnel": 0.7, "mouthPucker": 0.15},
    "U": {"jawOpen": 0.12, "mouthPucker": 0.75, "mouthFunnel": 0.45},
}


def sided(weights: dict[str, float], shapes: frozenset[str]) -> dict[str, float]:
    """The weights with those of both sides for names that shapes have by sides alone."""
    return {
        own: weight
        for name, weight in weights.items()
        for own in ((name,) if name in shapes else (name + side for side in _BOTH))
    }


def sliders(shapes: frozenset[str]) -> tuple[Slider, ...]:
    """The sliders of a head that has the shapes of ARKit."""
    made = [
        Slider(name=prefix + name, group=group, shapes=tuple(sided(weights, shapes).items()))
        for group, prefix, table in (("expression", "", _MOODS), ("visemes", "viseme_", VISEMES))
        for name, weights in table.items()
    ]
    return (
        *made,
        _look("lookLeft", "ry", ("eyeLookOutLeft", "eyeLookInRight"), ("eyeLookInLeft", "eyeLookOutRight")),
        _look("lookDown", "rx", ("eyeLookDownLeft", "eyeLookDownRight"), ("eyeLookUpLeft", "eyeLookUpRight")),
    )


def _look(name: str, channel: str, there: tuple[str, ...], back: tuple[str, ...]) -> Slider:
    """Turns both eyes, and has the lids follow them either way."""
    return Slider(
        name=name,
        group="eyes",
        minimum=-1.0,
        channels=((_LEFT, channel, _TURN), (_RIGHT, channel, _TURN)),
        channel_curves=(None, None),
        shapes=tuple((shape, 1.0) for shape in (*there, *back)),
        shape_curves=(_RISING,) * len(there) + (_FALLING,) * len(back),
    )
