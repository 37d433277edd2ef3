"""How near the bones of sliders come to the shapes that these were made from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from facepipe.reports import Report

FloatArray = npt.NDArray[np.floating]


@dataclass(frozen=True, kw_only=True)
class EndReport:
    """One end of a slider: a shape, over all points of the face."""

    shape: str
    rms_mm: float  # of the shape's motion
    max_mm: float
    left_rms_mm: float  # of what bones leave
    left_max_mm: float
    reach: float  # 1 - RMS left / RMS of the motion, at least 0
    residual_points: int = 0


@dataclass(frozen=True, kw_only=True)
class MadeSlider:
    """One slider."""

    group: str
    ends: tuple[EndReport, ...]
    joints: int
    channels: int
    symmetric: bool  # both sides of the face move as mirror images
    mirror: str | None = None
    by: str = "bones"  # "bones", "bones and residual", "shapes"; "" where it was left out

    @property
    def reach(self) -> float:
        """Of both ends."""
        return reach_of(self.ends)


@dataclass(frozen=True, kw_only=True)
class GroupReach:
    """The sliders of a group, those left out too."""

    sliders: int
    left_out: int
    rms_mm: float  # of all motions
    left_rms_mm: float
    reach: float


@dataclass(frozen=True, kw_only=True)
class ShapeSlidersReport(Report):
    """What was made."""

    sliders: Mapping[str, MadeSlider]
    left_out: Mapping[str, MadeSlider] = field(default_factory=dict)  # bones reach too little of them
    groups: Mapping[str, GroupReach] = field(default_factory=dict)
    unmoved: tuple[str, ...] = ()  # shapes that move no point, or by no more than rounding
    replaced: tuple[str, ...] = ()  # sliders that the face had by the same name
    dropped: tuple[str, ...] = ()  # sliders that the face had and has no more
    beyond_limits: tuple[str, ...] = ()  # "slider -> joint:channel" beyond the face's own limits
    authored: tuple[str, ...] = ()
    seconds: float = 0.0


def end_report(shape: str, motion: FloatArray, left: FloatArray, mm: float) -> EndReport:
    """Of (n,) lengths in stage units."""
    rms, rest = (float(np.sqrt((one**2).mean())) * mm for one in (motion, left))
    return EndReport(
        shape=shape,
        rms_mm=rms,
        max_mm=float(motion.max()) * mm,
        left_rms_mm=rest,
        left_max_mm=float(left.max()) * mm,
        reach=max(0.0, 1.0 - rest / rms) if rms else 0.0,
    )


def reach_of(ends: tuple[EndReport, ...]) -> float:
    """How much of the motion of several shapes bones make, by their squares."""
    motion, left = (float(np.hypot.reduce([getattr(one, name) for one in ends])) for name in ("rms_mm", "left_rms_mm"))
    return max(0.0, 1.0 - left / motion) if motion else 0.0


def by_group(made: Mapping[str, MadeSlider], left_out: Mapping[str, MadeSlider]) -> dict[str, GroupReach]:
    """Group -> its sliders, in the order of their first ones."""
    groups: dict[str, list[MadeSlider]] = {}
    for one in (*made.values(), *left_out.values()):
        groups.setdefault(one.group, []).append(one)
    lost = {id(one) for one in left_out.values()}
    found = {}
    for name, own in groups.items():
        ends = tuple(end for one in own for end in one.ends)
        found[name] = GroupReach(
            sliders=len(own),
            left_out=sum(id(one) in lost for one in own),
            rms_mm=float(np.sqrt(np.mean([end.rms_mm**2 for end in ends]))),
            left_rms_mm=float(np.sqrt(np.mean([end.left_rms_mm**2 for end in ends]))),
            reach=reach_of(ends),
        )
    return found
