"""Lips that roll in, farther before the teeth than the source's: through those of some people an edge of them came."""

from __future__ import annotations

import numpy as np
from anatomy import smooth
from model import Floats

ROLLS = {"mouthRollLower": (0.0, 0.07, 0.1), "mouthRollUpper": (0.0, -0.1, 0.15)}  # cm, added where lips move most
SHARES = (0.1, 0.7)  # of a shape's farthest motion, between which that is eased in


def rolled(shapes: dict[str, Floats]) -> dict[str, Floats]:
    """The shapes with lips that roll over the teeth."""
    return shapes | {name: _further(shapes[name], np.array(added)) for name, added in ROLLS.items()}


def _further(shape: Floats, added: Floats) -> Floats:
    way = np.linalg.norm(shape, axis=1)
    low, high = (share * way.max() for share in SHARES)
    return shape + smooth((way - low) / (high - low))[:, None] * added
