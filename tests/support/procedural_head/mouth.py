"""The mouth patch: skin around the lips, the red of the lips, their inner roll and the mouth bag."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray
from procedural_head import features
from procedural_head.identity import Identity
from procedural_head.skull import Skull

OUTLINE = 5  # ring of the border between skin and lip red
CONTACT = 9  # ring where the closed lips touch
RINGS = 15
_GAP = 0.008  # between the closed lips, so that no face lies in another


@dataclass(frozen=True)
class Lips:
    """Outlines of the lips in the frontal plane."""

    half_width: float
    height: float  # y of the mouth's corners
    upper: float
    lower: float

    def line(self, x: FloatArray) -> FloatArray:
        """y of the line between the closed lips."""
        u = np.clip(np.abs(x) / self.half_width, 0, 1)
        return np.asarray(self.height - 0.05 * np.exp(-((u / 0.2) ** 2)) + 0.02 * np.sin(np.pi * u) + 0.04 * u**2)

    def upper_edge(self, x: FloatArray) -> FloatArray:
        """y of the upper lip's outline: a cupid's bow."""
        u = np.clip(np.abs(x) / self.half_width, 0, 1)
        bow = np.interp(u, [0, 0.10, 0.20, 0.32, 0.55, 0.8, 1], [0.80, 0.88, 1.0, 0.97, 0.72, 0.36, 0])
        return np.asarray(self.line(x) + self.upper * bow)

    def lower_edge(self, x: FloatArray) -> FloatArray:
        """y of the lower lip's outline."""
        u = np.clip(np.abs(x) / self.half_width, 0, 1)
        return np.asarray(self.height + 0.04 * u**2 - self.lower * (1 - u**2.2) ** 0.9)


def lips(who: Identity) -> Lips:
    """The lips of an identity."""
    return Lips(
        half_width=2.4 + 0.17 * who.mouth_width,
        height=-6.6 - 0.12 * who.mouth_height,
        upper=0.78 + 0.15 * who.upper_lip,
        lower=0.95 + 0.17 * who.lower_lip,
    )


def place(outline: FloatArray, skull: Skull, who: Identity) -> FloatArray:
    """(rings + 1, spokes, 3) points of the patch; `outline` (spokes, 3) is its ring 0."""
    shape = lips(who)
    spokes = outline.shape[0]
    half = spokes // 2
    across = np.arange(spokes)
    across = np.where(across <= half, across, spokes - across) / half
    lip_x = shape.half_width * (0.55 * np.cos(np.pi * across) + 0.45 * (1 - 2 * across))
    upper = np.arange(spokes) <= half
    edge_y = np.where(upper, shape.upper_edge(lip_x), shape.lower_edge(lip_x))
    side = np.where(upper, 1.0, -1.0)
    side[[0, half]] = 0.0
    flat = _frontal_rings(outline, lip_x, edge_y, shape.line(lip_x) + side * _GAP / 2)
    outer = _raise(flat, skull, who, shape, upper)
    return np.concatenate([outline[None], outer, _inside(outer[-1], lip_x / shape.half_width, side, across)])


def _frontal_rings(outline: FloatArray, x: FloatArray, edge: FloatArray, line: FloatArray) -> FloatArray:
    """(CONTACT, spokes, 2) x and y of rings 1..CONTACT."""
    rim = np.stack([x, edge], axis=1)
    share = np.linspace(0, 1, OUTLINE + 1)[1:, None, None] ** 0.9
    skin = outline[None, :, :2] * (1 - share) + rim[None] * share
    share = np.array([0.27, 0.55, 0.82, 1.0])[:, None, None]
    red = rim[None] * (1 - share) + np.stack([x * 0.95, line], axis=1)[None] * share
    return np.concatenate([skin, red])


def _raise(flat: FloatArray, skull: Skull, who: Identity, shape: Lips, upper: FloatArray) -> FloatArray:
    """(CONTACT, spokes, 3) the rings on the face, with the lips' bulge."""
    angle, level = skull.coordinates(flat[..., 0].ravel(), flat[..., 1].ravel())
    points = features.displace(skull.surface(angle, level), who)
    points[:, :2] = flat.reshape(-1, 2)
    x, y = np.abs(points[:, 0]), points[:, 1]
    philtrum = np.clip((y - shape.height - shape.upper * 0.9) / 0.3, 0, 1) * np.clip((-4.9 - y) / 0.3, 0, 1)
    points[:, 2] += philtrum * (0.06 * np.exp(-(((x - 0.42) / 0.2) ** 2)) - 0.09 * np.exp(-((x / 0.24) ** 2)))
    corner = np.exp(-(((x - shape.half_width - 0.12) / 0.42) ** 2) - ((y - shape.height) / 0.5) ** 2)
    points[:, 2] -= 0.22 * corner
    rings = points.reshape(*flat.shape[:2], 3)
    taper = np.clip(1 - (np.abs(flat[OUTLINE - 1, :, 0]) / shape.half_width) ** 2, 0, 1) ** 0.6
    # Full lips bulge more, but meet at the same depth.
    bulge = np.linspace(1.0, 0.0, CONTACT - OUTLINE + 1) ** 0.5
    bulge = np.concatenate([np.ones(OUTLINE - 1), bulge])[:, None]
    full = 1 + 0.12 * bulge * np.where(upper, who.upper_lip, who.lower_lip)
    skin = np.array([0.0, 0.01, 0.04, 0.11])
    upper_profile = np.append(skin, [0.22, 0.33, 0.41, 0.40, 0.15])
    lower_profile = np.append(skin, [0.17, 0.40, 0.54, 0.50, 0.15])
    rings[..., 2] += np.where(upper, upper_profile[:, None], lower_profile[:, None]) * taper * full
    return rings


def _inside(contact: FloatArray, across_x: FloatArray, side: FloatArray, across: FloatArray) -> FloatArray:
    """(6, spokes, 3) rings from the back of the lips' contact into the mouth bag."""
    arch = np.sin(np.pi * across) ** 0.6 * side
    height = np.array([0.0, 0.32, 0.95, 1.25, 1.2, 0.6])
    half_width = np.array([0.0, 0.0, 0.12, 0.35, 0.15, -0.5])
    back = np.array([0.3, 0.42, 0.54, 2.1])
    rings = np.repeat(contact[None], 6, axis=0)
    rings[..., 1] += height[:, None] * arch
    rings[..., 0] += half_width[:, None] * across_x
    rings[:4, :, 2] -= back[:, None]
    rings[4, :, 2] = 5.0
    rings[5, :, 2] = 3.6
    return rings
