"""What measures do to the head, as `samples/head/directions.py` found it: one nose is wider, and nothing else is."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray
from facepipe.heads.asset import arrays, asset, unpacked

SIDES = ("Left", "Right")
MEET = 0.433  # cm below the middle of an eye: where lids meet
_MIDDLE = 1.0  # cm on each side of the middle, over which left and right mix


@dataclass(frozen=True, kw_only=True)
class Direction:
    """Two standard deviations of a measure, or what is typical of sex or age."""

    name: str
    group: str
    offsets: npt.NDArray[np.float32]  # (n, 3) cm, symmetric, less what joints do: 0 on the eyeballs
    eyes: FloatArray  # (2, 5) left and right: translation in cm, what is added to its scale, and to that of its lids
    sided: bool  # whether each side has a control of its own

    @cached_property
    def shapes(self) -> tuple[Direction, ...]:
        """What blendshapes are made of: its left and right half, which add up to it, or itself."""
        return (self._half(0), self._half(1)) if self.sided else (self,)

    def _half(self, side: int) -> Direction:
        across = np.clip(asset().points[:, :1] * (1 - 2 * side) / _MIDDLE, -1.0, 1.0)
        share = 0.5 + across * (3.0 - across**2) / 4.0  # a smooth step
        offsets = np.round(self.offsets * share, 3).astype(np.float32)  # as the whole ones are: half the memory
        eyes = self.eyes * (np.arange(2) == side)[:, None]
        return replace(self, name=self.name + SIDES[side], offsets=offsets, eyes=eyes)


@cache
def directions() -> tuple[Direction, ...]:
    """Of all the measures, and of the traits."""
    found = arrays("measures")
    names = [*found["names"], *found["traits"]]
    groups = [*found["groups"], *("person" for _ in found["traits"])]
    sided = [*found["sided"], *(False for _ in found["traits"])]
    return tuple(
        Direction(name=str(names[i]), group=str(groups[i]), offsets=own, eyes=found["eyes"][i], sided=bool(sided[i]))
        for i, own in enumerate(unpacked(found["offsets"]))
    )
