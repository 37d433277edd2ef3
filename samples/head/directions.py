"""What a measure does to the head: one nose is wider than another, and nothing else is.

A direction is the sum over masks and identity modes of ``weight * mask * mode``; `measures` finds the weights. Eyeballs
are left out: joints move them as a whole, so that they go on turning about their middles. Joints open the eyes too: a
shape would part lids that a blink has closed, where joints, which come after shapes, leave them together.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from lids import Stretch
from masks import masks
from measures import STEP
from packing import packed

REACH = 2.0  # standard deviations of its measure that a direction goes
EYES = ("EyeballLeft", "EyeballRight")
FAINTEST, SHOWN = 0.005, 0.01  # cm: points that move less than the first stay, those of the second are as they are
INSIDE = ("Teeth", "GumsAndTongue")
INSIDE_LEAST = 0.04  # cm: what moves less than that altogether stays

Floats = npt.NDArray[np.float64]
Arrays = Mapping[str, npt.NDArray[Any]]


def build(
    points: Floats, modes: npt.NDArray[Any], parts: Mapping[str, slice], found: Arrays, stretch: Stretch
) -> dict[str, Any]:
    """What joints do to the eyes in each direction, and offsets of the points for the rest, packed.

    :param found: weights of the modes for measures and traits
    """
    weights, parity, modes = found["weights"] * STEP, found["parity"], modes.astype(np.float64)
    traits = np.tensordot(found["trait_weights"] * STEP, modes, axes=1)
    moved = np.concatenate([REACH * combined(points, modes, parts, weights, parity), traits])
    eyes = np.stack([_as_a_whole(points[parts[name]], moved[:, parts[name]]) for name in EYES], axis=1)
    for name in EYES:
        moved[:, parts[name]] = 0.0
    for name in INSIDE:
        own = moved[:, parts[name]]
        own[np.abs(own).max(axis=(1, 2)) < INSIDE_LEAST] = 0.0
    opening = stretch.opening(moved)
    moved[..., 1] -= opening[:, None] * stretch.up
    eyes = np.dstack([eyes, np.stack([opening, opening], axis=1)])
    return {"offsets": packed(_quiet(moved)), "eyes": np.round(eyes, 6).astype(np.float32)}


def combined(points: Floats, modes: Floats, parts: Mapping[str, slice], weights: Floats, parity: Floats) -> Floats:
    """(d, n, 3) offsets of weights (d, masks, modes), those on the right times the parity (modes,)."""
    total = np.zeros((len(weights), *points.shape))
    for shares, signs in zip(masks(points, parts), (np.ones_like(parity), parity), strict=True):
        for number, share in enumerate(shares):
            own = np.flatnonzero(share)
            moved = (weights[:, number] * signs) @ modes[:, own].reshape(len(modes), -1)
            total[:, own] += share[own, None] * moved.reshape(len(weights), len(own), 3)
    return total


def _as_a_whole(ball: Floats, offsets: Floats) -> Floats:
    """(d, 4) the translation and change of scale about its middle that come nearest to offsets (d, k, 3) of a ball."""
    arms = ball - ball.mean(axis=0)
    return np.column_stack([offsets.mean(axis=1), (offsets * arms).sum(axis=(1, 2)) / (arms**2).sum()])


def _quiet(offsets: Floats) -> Floats:
    """The offsets, those that are hardly any faded out."""
    lengths = np.sqrt((offsets**2).sum(axis=-1, keepdims=True))
    share = np.clip((lengths - FAINTEST) / (SHOWN - FAINTEST), 0.0, 1.0)
    return np.asarray(offsets * (share**2 * (3.0 - 2.0 * share)))
