"""Who the sample is: the proportions and colours that a seed chooses."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

Color = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Identity:
    """Differences from the average head, in standard deviations (about -2..2); colours are linear."""

    face_width: float = 0.0
    cranium_width: float = 0.0
    cranium_height: float = 0.0
    jaw_width: float = 0.0
    chin_length: float = 0.0
    chin_depth: float = 0.0
    chin_width: float = 0.0
    brow_depth: float = 0.0
    brow_height: float = 0.0
    brow_tilt: float = 0.0
    brow_thickness: float = 0.0
    eye_spacing: float = 0.0
    eye_opening: float = 0.0
    eye_tilt: float = 0.0
    eye_size: float = 0.0
    nose_length: float = 0.0
    nose_width: float = 0.0
    nose_depth: float = 0.0
    nose_bridge: float = 0.0
    nose_tip: float = 0.0
    mouth_width: float = 0.0
    mouth_height: float = 0.0
    upper_lip: float = 0.0
    lower_lip: float = 0.0
    cheekbones: float = 0.0
    cheek_fullness: float = 0.0
    ear_size: float = 0.0
    ear_angle: float = 0.0
    neck_width: float = 0.0
    skin: Color = (0.60, 0.335, 0.225)
    hair: Color = (0.035, 0.02, 0.012)
    iris: Color = (0.10, 0.17, 0.20)


_SKINS: tuple[Color, ...] = (
    (0.66, 0.40, 0.29),
    (0.60, 0.335, 0.225),
    (0.50, 0.26, 0.155),
    (0.36, 0.175, 0.10),
    (0.23, 0.105, 0.06),
)
_HAIR: tuple[Color, ...] = ((0.012, 0.009, 0.008), (0.035, 0.02, 0.012), (0.09, 0.05, 0.025), (0.20, 0.12, 0.055))
_IRISES: tuple[Color, ...] = ((0.09, 0.04, 0.015), (0.05, 0.022, 0.012), (0.10, 0.17, 0.20), (0.12, 0.14, 0.05))


def from_seed(seed: int) -> Identity:
    """The identity of a seed; seed 0 is the average head."""
    if seed == 0:
        return Identity()
    random = np.random.default_rng(seed)
    names = [field.name for field in fields(Identity) if field.type == "float"]
    values = np.clip(random.normal(size=len(names)), -1.9, 1.9)
    skin = random.uniform(0.0, len(_SKINS) - 1.0)
    # The two fairest of the hair and eye colours only go with the lighter half of the skins.
    choices = 4 if skin < 2.0 else 2
    hair, iris = random.integers(choices, size=2)
    return Identity(
        skin=_between(_SKINS, float(skin)),
        hair=_HAIR[hair],
        iris=_IRISES[iris],
        **dict(zip(names, map(float, values), strict=True)),
    )


def _between(colors: tuple[Color, ...], position: float) -> Color:
    low = min(int(position), len(colors) - 2)
    mixed = np.array(colors[low]) * (low + 1 - position) + np.array(colors[low + 1]) * (position - low)
    return (float(mixed[0]), float(mixed[1]), float(mixed[2]))
