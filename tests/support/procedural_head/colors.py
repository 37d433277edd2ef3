"""Colours of the head's points."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray
from procedural_head import eyes, features, layout, mouth, scalp
from procedural_head.identity import Identity


def head(points: FloatArray, who: Identity) -> FloatArray:
    """(n, 3) linear colours 0..1."""
    skin = np.array(who.skin)
    colors = np.tile(skin, (len(points), 1))
    blood = 0.6 * features.bump(points, (3.9, -3.3), (2.3, 2.0)) + 0.5 * features.bump(points, (0, -3.8), (1.4, 1.0))
    labels = layout.build()
    ears = (labels.ring["earLeft"] >= 2) | (labels.ring["earRight"] >= 2)
    blood = np.maximum(blood, 0.8 * ears)
    colors = _mix(colors, skin * (1.06, 0.80, 0.76), blood)
    colors = _mix(colors, skin * (0.78, 0.66, 0.66), 0.5 * features.bump(points, (2.9, 0.1), (1.8, 1.1)))
    colors = _mix(colors, skin * 0.88, 0.8 * features.bump(points, (0.0, -8.6), (2.6, 2.4)) * _beard(who))
    under = layout.smoothstep(-10.6, -12.2, points[:, 1]) * layout.smoothstep(-1.0, 4.0, points[:, 2])
    colors = _mix(
        colors, skin * (0.72, 0.62, 0.60), 0.6 * under + 0.35 * features.bump(points, (0.0, -4.75), (1.3, 0.25))
    )
    colors = _mix(colors, np.array(who.hair), 0.7 * _haired(points))
    return np.clip(_openings(colors, skin, labels), 0.0, 1.0)


def _haired(points: FloatArray) -> FloatArray:
    """(n,) 1 under the hair, 0 on skin; softer than the hair's edge, like stubble."""
    angle = np.arctan2(points[:, 0], points[:, 2] + 0.5)
    mask = layout.smoothstep(0.4, 1.4, points[:, 1] - scalp.line(angle))
    labels = layout.build()
    ears = (labels.ring["earLeft"] >= 1) | (labels.ring["earRight"] >= 1)
    return np.where(ears, 0.0, mask)


def _beard(who: Identity) -> float:
    return float(np.clip(who.brow_thickness * 0.5 + 0.3, 0.0, 1.0))


def _openings(colors: FloatArray, skin: FloatArray, labels: layout.Layout) -> FloatArray:
    lip = skin * (0.86, 0.50, 0.52)
    flesh = np.array([0.30, 0.07, 0.06])
    ring = labels.ring["mouth"]
    red = np.interp(ring, [mouth.OUTLINE - 1, mouth.OUTLINE, mouth.OUTLINE + 1], [0.0, 0.55, 1.0])
    colors = _mix(colors, lip, red)
    colors = _mix(colors, lip * 0.55, np.interp(ring, [mouth.CONTACT - 1, mouth.CONTACT], [0.0, 0.6]))
    colors = _mix(colors, flesh, np.interp(ring, [mouth.CONTACT, mouth.CONTACT + 2], [0.0, 1.0]))
    colors = _mix(colors, flesh * 0.25, np.interp(ring, [mouth.CONTACT + 3, mouth.RINGS], [0.0, 1.0]))
    for side in ("Left", "Right"):
        lids = labels.ring["eye" + side]
        crease = (
            np.interp(lids, [1, 3, 4, 5], [0.0, 0.45, 0.2, 0.0])
            * (lids >= 0)
            * np.nan_to_num(labels.upper["eye" + side])
        )
        colors = _mix(colors, skin * (0.55, 0.38, 0.36), crease)
        colors = _mix(colors, skin * (0.80, 0.55, 0.52), 0.6 * (lids == eyes.RIM))
        colors = _mix(colors, skin * (0.85, 0.48, 0.46), 0.8 * (lids > eyes.RIM))
        nostril = labels.ring["nostril" + side]
        colors = _mix(colors, skin * (0.16, 0.08, 0.07), np.interp(nostril, [0, 1, 2], [0.0, 0.55, 1.0]))
        concha = labels.ring["ear" + side]
        colors = _mix(colors, skin * (0.5, 0.3, 0.28), np.interp(concha, [6, 8], [0.0, 0.9]))
    return colors


def _mix(colors: FloatArray, target: FloatArray, share: FloatArray) -> FloatArray:
    return np.asarray(colors + share[:, None] * (target - colors))
