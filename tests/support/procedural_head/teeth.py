"""Rows of teeth with their gums, and the tongue."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from procedural_head import mouth
from procedural_head.identity import Identity
from procedural_head.solids import Solid, sphere, strip

_TEETH = 14
_SAMPLES = 3  # per tooth
# Cross-section of the upper row, front to back: y above the lip line, depth behind the front, share of gum colour.
_HEIGHT = np.array([1.5, 0.92, 0.86, 0.3, -0.12, -0.1, 0.6, 1.2])
_DEPTH = np.array([0.25, 0.02, 0.0, -0.04, 0.05, 0.2, 0.48, 0.7])
_IS_GUM = np.array([1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
IVORY = (0.82, 0.76, 0.64)
GUM = (0.42, 0.12, 0.11)
TONGUE = (0.45, 0.13, 0.12)


def row(who: Identity, *, upper: bool) -> tuple[Solid, FloatArray]:
    """A row of teeth and its (n, 3) colours."""
    lips = mouth.lips(who)
    u = np.linspace(-1, 1, _TEETH * _SAMPLES + 1)
    gap = np.abs(np.cos(np.pi * u * _TEETH / 2)) ** 6
    width = 2.3 if upper else 2.15
    front = 9.15 if upper else 8.9
    turn = u * np.radians(88)
    arch = np.stack([width * np.sin(turn), np.zeros_like(u), front - 2.9 * (1 - np.cos(turn))], axis=1)
    out = np.stack([np.sin(turn), np.zeros_like(u), np.cos(turn)], axis=1)
    height, depth, gum = _HEIGHT, _DEPTH, _IS_GUM
    shrink = (1 - 0.22 * np.abs(u)) * (1.0 if upper else 0.88)
    y = (
        height[:, None] * shrink
        + 0.09 * gap * (height[:, None] < 0.2)
        - 0.07 * gap * ((gum[:, None] > 0) & (height[:, None] < 1))
    )
    side = 1.0 if upper else -1.0
    level = lips.height - (0.05 if upper else 0.22)
    inset = depth[:, None] + 0.055 * gap * (gum[:, None] == 0)
    points = arch[None] - inset[..., None] * out[None]
    points[..., 1] = level + side * y
    solid = strip(points if not upper else points[::-1])
    color = (
        np.array(IVORY) * (1 - 0.45 * gap[None, :, None]) * (1 - gum[:, None, None])
        + np.array(GUM) * gum[:, None, None]
    )
    return solid, (color if not upper else color[::-1]).reshape(-1, 3)


def face_groups(*, upper: bool) -> dict[str, IntArray]:
    """Faces of a row's teeth and gum, by material."""
    gum = (_IS_GUM[:-1] + _IS_GUM[1:]) > 0
    gum = np.repeat(gum[::-1] if upper else gum, _TEETH * _SAMPLES)
    return {"Gums": np.nonzero(gum)[0].astype(np.int32), "Teeth": np.nonzero(~gum)[0].astype(np.int32)}


def tongue(who: Identity) -> tuple[Solid, FloatArray]:
    """The tongue and its (n, 3) colours."""
    solid = sphere(np.radians([14, 30, 48, 66, 90, 115, 145]), 12)
    points = solid.points * (1.65, 0.55, 2.4)
    points[:, 1] *= np.where(points[:, 1] > 0, 0.75, 1.0)
    points[:, 1] -= 0.10 * np.exp(-((points[:, 0] / 0.4) ** 2)) * (points[:, 1] > 0)
    points += (0.0, mouth.lips(who).height - 0.82, 5.75)
    colors = np.tile(TONGUE, (len(points), 1))
    return Solid(points, solid.counts, solid.indices, solid.uvs), colors
