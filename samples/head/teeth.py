"""Teeth, gums and tongue of a smaller size than the source's, so that lips that roll or go sideways keep clear of them.

As they are, lips have so little room that teeth come through them in a tenth of random expressions; mending shapes one
by one would move lips by up to 8 mm, where teeth that lie 3 to 4 mm deeper do the same.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from anatomy import GUMS, TEETH, Jaw
from model import Floats, Ints, Model

SIZE = 0.92
_BACK = 1.0  # cm of depth that the last molars take
_BITE = 0.1  # share of their points that bites


def smaller(model: Model, jaw: Jaw) -> Model:
    """The model with upper and lower teeth scaled about the bite of their last molars, and what they are set in."""
    own = slice(GUMS.points[0], TEETH.points[1])
    share = jaw.share(model.points[own], model.shapes["jawOpen"][own])[:, None]
    upper, lower = (_pivot(model, jaw, low) for low in (False, True))

    def scaled(values: Floats) -> Floats:
        centre = (1 - share) * values[upper].mean(axis=0) + share * values[lower].mean(axis=0)
        found = values.copy()
        found[own] = centre + SIZE * (values[own] - centre)
        return found

    return replace(
        model,
        points=scaled(model.points),
        modes=np.stack([scaled(mode) for mode in model.modes]),
        shapes={name: scaled(shape) for name, shape in model.shapes.items()},
    )


def _pivot(model: Model, jaw: Jaw, low: bool) -> Ints:
    """Points of the last molars of a jaw where they meet the other jaw's."""
    teeth = np.arange(*TEETH.points)
    lower = jaw.share(model.points[teeth], model.shapes["jawOpen"][teeth]) > 0.5
    depth = model.points[teeth, 2]
    molars = teeth[(lower == low) & (depth < depth[lower == low].min() + _BACK)]
    order = np.argsort(model.points[molars, 1] * (-1.0 if low else 1.0), kind="stable")
    return molars[order[: round(_BITE * len(molars))]]
