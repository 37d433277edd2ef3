"""How near bones bring a face to its targets, in millimetres."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray
from facepipe.core.reports import Report, unsaid
from facepipe.rig import CHANNELS


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
    fitted: Any = unsaid()  # the targets, of which pictures are drawn

    @property
    def missed(self) -> tuple[str, ...]:
        """Targets that are not reached."""
        return tuple(name for name, target in self.targets.items() if not target.reached)


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


def by_region(
    values: FloatArray, masks: Mapping[str, FloatArray], known: npt.NDArray[np.bool_]
) -> dict[str, Distances]:
    """Of distances (T, n) of known points, in the region that most of each is in."""
    if not masks:
        return {}
    table = np.stack(list(masks.values()))
    largest = np.where(table.max(axis=0) > 0, table.argmax(axis=0), -1)
    inside = {name: (largest == number) & known for number, name in enumerate(masks)}
    return {name: distances(values[:, own]) for name, own in inside.items() if own.any()}


def at_limits(
    coefficients: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    joints: tuple[str, ...],
    free: npt.NDArray[np.integer],
) -> tuple[str, ...]:
    """``joint:channel`` of the free joints' channels that a frame of (T, m, 9) has at a limit, where not locked."""
    held = ((coefficients <= lower) | (coefficients >= upper)).any(axis=0) & (lower < upper)
    allowed = np.isin(np.arange(len(joints)), free)
    return tuple(f"{joints[i]}:{CHANNELS[channel]}" for i, channel in np.argwhere(held & allowed[:, None]))
