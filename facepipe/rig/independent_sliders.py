"""Which sliders of a face say something that others don't."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray
from facepipe.parts import Slider

_SAME = 0.01  # of an effect: less is rounding


def independent(sliders: Sequence[Slider]) -> BoolArray:
    """(s,) whether a slider is needed to reach what all of them can.

    Left out are mixes of others before them, and both sliders of a pair that together do what one does for both sides.
    Sliders with curves are none of these.
    """
    straight = [not (one.channel_curves or one.shape_curves) for one in sliders]
    effects, names = _effects(sliders), {one.name: i for i, one in enumerate(sliders)}
    span: FloatArray = np.zeros((0, effects.shape[1]))
    kept = np.array([not plain for plain in straight])
    for i, one in enumerate(sliders):
        if straight[i] and one.mirror is None:
            span, kept[i] = _extended(span, effects[i])
    for i, one in enumerate(sliders):
        if straight[i] and one.mirror is not None:
            both = effects[i] + effects[names[one.mirror]] if one.mirror in names else effects[i]
            kept[i] = _extended(span, both)[1]
    return kept


def _effects(sliders: Sequence[Slider]) -> FloatArray:
    """(s, targets) gains of each slider on each shape and channel."""
    gains = [
        {**{(joint, channel): gain for joint, channel, gain in one.channels}, **dict(one.shapes)} for one in sliders
    ]
    columns = {target: i for i, target in enumerate(dict.fromkeys(target for own in gains for target in own))}
    found = np.zeros((len(sliders), len(columns)))
    for row, own in zip(found, gains, strict=True):
        row[[columns[target] for target in own]] = list(own.values())
    return found


def _extended(span: FloatArray, effect: FloatArray) -> tuple[FloatArray, bool]:
    """Orthonormal rows (r, targets) with what an effect adds to them, and whether that is anything."""
    left = effect - (effect @ span.T) @ span
    left -= (left @ span.T) @ span  # twice is enough against rounding
    size = float(np.linalg.norm(left))
    if size <= _SAME * float(np.linalg.norm(effect)) or size == 0.0:
        return span, False
    return np.vstack([span, left / size]), True
