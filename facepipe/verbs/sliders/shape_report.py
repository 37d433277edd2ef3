"""How near the bones of sliders come to the shapes that these were made from."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.reports import Report, table

_HEAD = ("distance, mm", "by", "joints", "channels", "reach", "RMS", "max", "RMS left", "max left")


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
    end_max_mm: float  # at the slider's end, with residual or shape where it drives one


@dataclass(frozen=True, kw_only=True)
class MadeSlider:
    """One slider."""

    group: str
    ends: tuple[EndReport, ...]  # the lower one first
    reach: float  # of all ends
    joints: int
    channels: int
    symmetric: bool  # both sides of the face move as mirror images, or this slider and its mirror do
    mirror: str | None
    by: str  # "bones", "bones and residual", "shapes"; "" where it was left out


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
    unmoved: tuple[str, ...] = ()  # shapes that move no point
    replaced: tuple[str, ...] = ()  # sliders that the face had by the same names
    dropped: tuple[str, ...] = ()  # sliders that the face had and has no more
    beyond_limits: tuple[str, ...] = ()  # "slider -> joint:channel" beyond the face's own limits
    authored: tuple[str, ...] = ()
    seconds: float = 0.0

    def as_text(self, out: Path) -> str:
        """A table for people, the sliders of each group below it."""
        sliders = {**self.sliders, **self.left_out}
        rows: list[Sequence[object]] = [_HEAD]
        for group, reach in self.groups.items():
            numbers = (f"{reach.reach:.2f}", f"{reach.rms_mm:.2f}", "", f"{reach.left_rms_mm:.2f}")
            rows.append((group or "(no group)", "", "", "", *numbers))
            rows += [_row(name, slider) for name, slider in sliders.items() if slider.group == group]
        return f"{out}: {self._count()} in {self.seconds:.1f} s\n{table(rows)}"

    def _count(self) -> str:
        shapes = sum(len(slider.ends) for slider in (*self.sliders.values(), *self.left_out.values()))
        parts = [f"{len(self.sliders)} sliders of {shapes} shapes"]
        for what, names in (("left out", self.left_out), ("replaced", self.replaced), ("dropped", self.dropped)):
            parts += [f"{len(names)} {what}"] if names else []
        return ", ".join(parts)


def _row(name: str, slider: MadeSlider) -> tuple[object, ...]:
    rms, left = (
        math.sqrt(sum(value**2 for value in values) / len(slider.ends))
        for values in ([end.rms_mm for end in slider.ends], [end.left_rms_mm for end in slider.ends])
    )
    largest, last = max(end.max_mm for end in slider.ends), max(end.left_max_mm for end in slider.ends)
    numbers = (f"{slider.reach:.2f}", f"{rms:.2f}", f"{largest:.1f}", f"{left:.2f}", f"{last:.1f}")
    return (f"  {name}", slider.by or "left out", slider.joints, slider.channels, *numbers)


def end_report(shape: str, motion: FloatArray, left: FloatArray, end: FloatArray, residual_points: int) -> EndReport:
    """Of (n,) lengths in millimetres: the shape's motion, what bones leave, what the slider's end leaves."""
    rms, rest = (float(np.sqrt((one**2).mean())) for one in (motion, left))
    return EndReport(
        shape=shape,
        rms_mm=rms,
        max_mm=float(motion.max()),
        left_rms_mm=rest,
        left_max_mm=float(left.max()),
        reach=max(0.0, 1.0 - rest / rms) if rms else 0.0,
        residual_points=residual_points,
        end_max_mm=float(end.max()),
    )


def reach_of(motions: Sequence[float], left: Sequence[float]) -> float:
    """How much bones reach of several motions, from their RMS and that of what is left of each."""
    length = float(np.linalg.norm(motions))
    return max(0.0, 1.0 - float(np.linalg.norm(left)) / length) if length else 0.0


def by_group(sliders: Sequence[MadeSlider]) -> dict[str, GroupReach]:
    """Group -> its sliders, in the order of their first ones."""
    groups: dict[str, list[MadeSlider]] = {}
    for slider in sliders:
        groups.setdefault(slider.group, []).append(slider)
    reaches = {}
    for name, members in groups.items():
        ends = [end for slider in members for end in slider.ends]
        motions, left = np.array([end.rms_mm for end in ends]), np.array([end.left_rms_mm for end in ends])
        reaches[name] = GroupReach(
            sliders=len(members),
            left_out=sum(not slider.by for slider in members),
            rms_mm=float(np.sqrt((motions**2).mean())),
            left_rms_mm=float(np.sqrt((left**2).mean())),
            reach=reach_of(motions.tolist(), left.tolist()),
        )
    return reaches
