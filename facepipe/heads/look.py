"""How a person's skin, eyes and hair look."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.parts import Color

# Albedo of Monk's ten tones under even light, sRGB 0..255: the swatches show lit skin, which is lighter.
_TONES = (
    (229, 188, 170), (225, 181, 160), (219, 174, 147), (209, 161, 131), (193, 143, 111),
    (165, 116, 83), (137, 92, 66), (107, 71, 52), (86, 58, 45), (67, 47, 38),
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
    "crop": (0.9, "hair.png"),
    "parted": (0.9, "hair.png"),
    "bob": (0.9, "hair.png"),
    "long": (0.9, "hair.png"),
    "coils": (0.97, "coils.png"),
}


@dataclass(frozen=True, kw_only=True)
class Look:
    """Colours and signs of one person; shares are 0..1."""

    seed: int = 0  # of what is placed by chance: mottling, pores, freckles, moles
    tone: float = 4.0  # Monk's scale, 1..10
    redness: float = 0.5  # blood in cheeks, nose and ears
    lips: float = 0.5  # colour of the lips
    age: float = 0.3  # lines and spots
    freckles: float = 0.0
    beard: float = 0.0  # stubble and its shade
    brows: float = 0.5  # how full they are
    eyes: str = "brown"  # one of IRIS
    hair: str = "dark"  # one of HAIR
    style: str = "crop"  # one of STYLES

    @property
    def hair_color(self) -> FloatArray:
        """(3,) linear."""
        return np.array(HAIR[self.hair])

    @property
    def skin(self) -> FloatArray:
        """(3,) linear albedo."""
        tones = ((np.array(_TONES) / 255 + 0.055) / 1.055) ** 2.4
        return np.array([np.exp(np.interp(self.tone, np.arange(1, 11), np.log(tones[:, c]))) for c in range(3)])

    @property
    def darkness(self) -> float:
        """0 for the lightest skin, 1 for the darkest."""
        return float(np.clip((self.tone - 1) / 9, 0, 1))
