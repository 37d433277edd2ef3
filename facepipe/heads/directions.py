"""What a measure does to the head: one nose is wider than another, and nothing else is.

A direction is the sum over masks and identity modes of ``weight * mask * mode`` (`samples/head/measures.py` finds the
weights). Eyeballs are left out: joints move them as a whole, so that they go on turning about their middles.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.heads.asset import Asset, arrays, asset
from facepipe.heads.masks import masks

REACH = 2.0  # standard deviations of its measure that a direction goes
SIDES = ("Left", "Right")
_EYES = ("EyeballLeft", "EyeballRight")
STEP = 1 / 2048  # of packed weights
_FAINTEST, _SHOWN = 0.005, 0.01  # cm: points that move less than the first stay, those of the second are as they are
_FAINT = 3e-4  # of a mask: none
_TINY = 2e-3  # of the weights in a mask: none
_INSIDE = ("Teeth", "GumsAndTongue")
_INSIDE_LEAST = 0.04  # cm: what moves less than that altogether stays
_MIDDLE = 1.0  # cm on each side of the middle, over which left and right mix


@dataclass(frozen=True, kw_only=True)
class Direction:
    """`REACH` standard deviations of a measure, or what is typical of sex or age."""

    name: str
    group: str
    offsets: FloatArray  # (n, 3) cm, symmetric; 0 on the eyeballs
    eyes: FloatArray  # (2, 4) of the left and the right eye: translation in cm, and what is added to its scale
    sided: bool  # whether each side has a control of its own

    @cached_property
    def shapes(self) -> tuple[Direction, ...]:
        """What blendshapes are made of: its left and right half, which add up to it, or itself."""
        return (self._half(0), self._half(1)) if self.sided else (self,)

    def _half(self, side: int) -> Direction:
        across = np.clip(asset().points[:, :1] * (1 - 2 * side) / _MIDDLE, -1.0, 1.0)
        share = 0.5 + across * (3.0 - across**2) / 4.0  # a smooth step
        eyes = self.eyes * (np.arange(2) == side)[:, None]
        return replace(self, name=self.name + SIDES[side], offsets=np.round(self.offsets * share, 3), eyes=eyes)


@cache
def directions() -> tuple[Direction, ...]:
    """Of all the measures, and of the traits."""
    head, found = asset(), arrays("measures")
    measures = REACH * combined(head, found["weights"] * np.float32(STEP), found["parity"])
    traits = np.tensordot(found["trait_weights"] * np.float32(STEP), head.modes, axes=1)
    moved = np.concatenate([measures, traits])
    eyes = np.stack([_as_a_whole(head, moved, name) for name in _EYES], axis=1)
    for name in _EYES:
        moved[:, head.parts[name].points] = 0.0
    for name in _INSIDE:
        own = moved[:, head.parts[name].points]
        own[np.abs(own).max(axis=(1, 2)) < _INSIDE_LEAST] = 0.0
    names = [*found["names"], *found["traits"]]
    groups = [*found["groups"], *("person" for _ in traits)]
    sided = [*found["sided"], *(False for _ in traits)]
    return tuple(
        Direction(name=str(names[i]), group=str(groups[i]), offsets=_quiet(own), eyes=eyes[i], sided=bool(sided[i]))
        for i, own in enumerate(moved)
    )


def combined(head: Asset, weights: FloatArray, parity: FloatArray) -> FloatArray:
    """(d, n, 3) offsets of weights (d, masks, modes), those on the right times the parity (modes,)."""
    shares = masks(head.points, {name: part.points for name, part in head.parts.items()}).astype(np.float32)
    total = np.zeros((len(weights), *head.points.shape), np.float32)
    for side, signs in enumerate((np.ones_like(parity), parity)):
        for number, share in enumerate(shares[side]):
            own = np.flatnonzero(share > _FAINT)
            rows = np.flatnonzero(np.abs(weights[:, number]).max(axis=1) > _TINY)
            if len(own):
                modes = head.modes[:, own].reshape(len(signs), -1)
                moved = (weights[rows, number] * signs).astype(np.float32) @ modes
                total[np.ix_(rows, own)] += share[own, None] * moved.reshape(-1, len(own), 3)
    return total


def _as_a_whole(head: Asset, offsets: FloatArray, name: str) -> FloatArray:
    """(d, 4) the translation and change of scale about its middle that come nearest to offsets of an eyeball."""
    own = head.parts[name].points
    arms = head.points[own] - head.points[own].mean(axis=0)
    scales = (offsets[:, own] * arms).sum(axis=(1, 2)) / (arms**2).sum()
    return np.column_stack([offsets[:, own].mean(axis=1), scales])


def _quiet(offsets: FloatArray) -> FloatArray:
    """The offsets, those that are hardly any faded out."""
    lengths = np.sqrt((offsets**2).sum(axis=-1, keepdims=True))
    share = np.clip((lengths - _FAINTEST) / (_SHOWN - _FAINTEST), 0.0, 1.0)
    return np.asarray(np.round(offsets * (share**2 * (3.0 - 2.0 * share)), 3))
