"""How near bones bring a face to its targets, in millimetres, as a report and as text."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.reports import Report, not_in_json, table
from facepipe.rig import CHANNELS

_SHOWN = 4  # names of a list
_REGIONS = 3  # of a single target, the worst


@dataclass(frozen=True, kw_only=True)
class Distances:
    """Distances of points from their targets, over all frames."""

    points: int
    mean_mm: float
    rms_mm: float
    p95_mm: float
    max_mm: float


@dataclass(frozen=True, kw_only=True)
class ResidualReport:
    """A corrective blendshape per frame that needs one."""

    shapes: int
    points: int  # offsets of all shapes together
    distances: Distances  # with bones and residual


@dataclass(frozen=True, kw_only=True)
class TargetReport:
    """One target."""

    animation: str  # the SkelAnimation that holds the coefficients
    frames: int
    before: Distances  # at the pose that the fit started from, points that count
    distances: Distances  # with bones alone, points that count
    regions: Mapping[str, Distances] = field(default_factory=dict)  # points by the region that most of them is in
    reached: bool  # within the threshold, with the residual where there is one
    steps: int  # of the solves that were kept, over all frames
    at_limits: tuple[str, ...] = ()  # "joint:channel" where some frame is stopped by a limit
    residual: ResidualReport | None = None


@dataclass(frozen=True, kw_only=True)
class FitBonesReport(Report):
    """What a bone fit did."""

    threshold_mm: float
    points: int
    joints: int
    free: int  # joints that could move
    weightless: tuple[str, ...]  # joints without influence on a point that counts: they keep their place
    targets: Mapping[str, TargetReport]
    authored: tuple[str, ...] = ()
    seconds: float = 0.0
    fitted: Any = not_in_json()  # the targets, of which pictures are drawn

    @property
    def missed(self) -> tuple[str, ...]:
        """Targets that are not reached."""
        return tuple(name for name, target in self.targets.items() if not target.reached)

    def as_text(self, out: Path) -> str:
        """How near each target is reached."""
        count = len(self.targets)
        decimals, residual = _decimals(self), any(target.residual for target in self.targets.values())
        head = ["distance, mm", "frames", "steps", "before", "mean", "RMS", "p95", "max"]
        rows: list[list[object]] = [[*head, *(["residual points", "max"] if residual else [])]]
        for name, target in self.targets.items():
            off, corrected = target.distances, target.residual
            numbers = (
                f"{value:.{decimals}f}"
                for value in (target.before.max_mm, off.mean_mm, off.rms_mm, off.p95_mm, off.max_mm)
            )
            rest = [f"{corrected.points:,}", f"{corrected.distances.max_mm:.{decimals}f}"] if corrected else []
            rows.append([name, target.frames, target.steps, *numbers, *rest, *([] if target.reached else ["missed"])])
        lines = [
            f"{out}: {count} target{'s' * (count != 1)}, {self.free} of {self.joints} joints, "
            f"{self.points:,} points in {self.seconds:.2f} s",
            table(rows),
            *(_worst_regions(target, _decimals(self)) for target in self.targets.values() if count == 1),
            *(
                f"{name}: stopped by limits: {_names(target.at_limits)}"
                for name, target in self.targets.items()
                if target.at_limits
            ),
        ]
        if self.weightless:
            lines.append(f"joints that move nothing, left as they are: {_names(self.weightless)}")
        return "\n".join(filter(None, lines))


def distances(values: FloatArray) -> Distances:
    """Of distances (..., points) in millimetres, frames before points."""
    values = np.atleast_2d(values)
    if not values.size:
        return Distances(points=0, mean_mm=0.0, rms_mm=0.0, p95_mm=0.0, max_mm=0.0)
    return Distances(
        points=values.shape[-1],
        mean_mm=float(values.mean()),
        rms_mm=float(np.sqrt((values**2).mean())),
        p95_mm=float(np.percentile(values, 95)),
        max_mm=float(values.max()),
    )


def by_region(off: FloatArray, masks: Mapping[str, FloatArray], known: BoolArray | None) -> dict[str, Distances]:
    """Of distances (T, n) of known points, all without `known` (n,), in the region that most of each is in."""
    if not masks:
        return {}
    shares = np.stack(list(masks.values()))
    largest = np.where(shares.max(axis=0) > 0, shares.argmax(axis=0), -1)
    if known is not None:
        largest[~known] = -1
    numbers = dict(enumerate(masks))
    return {name: distances(off[:, largest == number]) for number, name in numbers.items() if (largest == number).any()}


def at_limits(
    coefficients: FloatArray, lower: FloatArray, upper: FloatArray, joints: tuple[str, ...], free: IntArray
) -> tuple[str, ...]:
    """``joint:channel`` of the free joints' channels that a frame of (T, m, 9) has at a limit, where not locked."""
    held = ((coefficients <= lower) | (coefficients >= upper)).any(axis=0) & (lower < upper)
    allowed = np.isin(np.arange(len(joints)), free)
    return tuple(f"{joints[joint]}:{CHANNELS[channel]}" for joint, channel in np.argwhere(held & allowed[:, None]))


def _decimals(report: FitBonesReport) -> int:
    """Of distances: enough that they differ from the threshold."""
    return max(4, 1 - math.floor(math.log10(report.threshold_mm)))


def _worst_regions(target: TargetReport, decimals: int) -> str:
    if not target.regions:
        return ""
    worst = sorted(target.regions.items(), key=lambda item: -item[1].max_mm)[:_REGIONS]
    return "worst regions: " + ", ".join(f"{name} {off.max_mm:.{decimals}f} mm" for name, off in worst)


def _names(names: Sequence[str]) -> str:
    some = ", ".join(name.rpartition("/")[2] for name in names[:_SHOWN])
    return f"{len(names)} ({some}{', ...' if len(names) > _SHOWN else ''})"
