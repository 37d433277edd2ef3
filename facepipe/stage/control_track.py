"""Controls over time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class ControlTrack:
    """One control over time. What is not authored of its range and default is None."""

    name: str
    where: str  # the trail to its attribute
    codes: FloatArray  # (k,) time codes, ascending; none for one that has a value without time only
    values: FloatArray  # (k,), or (1,)
    minimum: float | None = None
    maximum: float | None = None
    default: float | None = None

    def at(self, codes: FloatArray) -> FloatArray:
        """(T,) values at time codes, straight between samples and held beyond them, as USD does."""
        if not len(self.codes):
            return np.full(len(codes), self.values[0])
        return np.interp(codes, self.codes, self.values)

    def guessed(self, codes: FloatArray) -> npt.NDArray[np.bool_]:
        """(T,) time codes without a sample, between two that differ."""
        if not len(self.codes):
            return np.zeros(len(codes), dtype=bool)
        after = np.searchsorted(self.codes, codes)
        before = np.searchsorted(self.codes, codes, side="right") - 1
        inside = (before >= 0) & (after < len(self.codes)) & (before != after)
        last = len(self.codes) - 1
        return np.asarray(inside & (self.values[np.maximum(before, 0)] != self.values[np.minimum(after, last)]))


@dataclass(frozen=True, kw_only=True)
class Clip:
    """Controls that move together."""

    name: str
    tracks: tuple[ControlTrack, ...]
    moves_joints: bool = False  # it animates joints too, which no control tells
