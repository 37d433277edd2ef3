"""Reports of bone fits as text."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.core.texts import table

if TYPE_CHECKING:
    from facepipe.processors.fit_bones import FitBonesReport, TargetReport

_SHOWN = 4  # names of a list
_REGIONS = 3  # of a single target, the worst


def as_text(out: Path, report: FitBonesReport) -> str:
    """How near each target is reached."""
    count = len(report.targets)
    lines = [
        f"{out}: {count} target{'s' * (count != 1)}, {report.free} of {report.joints} joints, "
        f"{report.points:,} points in {report.seconds:.2f} s",
        _targets(report),
        *(_regions(one, _decimals(report)) for one in report.targets.values() if count == 1 and one.regions),
        *(line for name, one in report.targets.items() for line in _at_limits(name, one)),
    ]
    if report.weightless:
        lines.append(f"joints that move nothing, left as they are: {_names(report.weightless)}")
    return "\n".join(lines)


def _targets(report: FitBonesReport) -> str:
    decimals, residual = _decimals(report), any(one.residual for one in report.targets.values())
    head = ["distance, mm", "frames", "steps", "before", "mean", "RMS", "p95", "max"]
    rows: list[list[object]] = [[*head, *(["residual points", "max"] if residual else [])]]
    for name, one in report.targets.items():
        off = one.distances
        numbers = (
            f"{value:.{decimals}f}" for value in (one.before.max_mm, off.mean_mm, off.rms_mm, off.p95_mm, off.max_mm)
        )
        rest = [f"{one.residual.points:,}", f"{one.residual.distances.max_mm:.{decimals}f}"] if one.residual else []
        rows.append([name, one.frames, one.steps, *numbers, *rest, *([] if one.reached else ["missed"])])
    return table(rows)


def _decimals(report: FitBonesReport) -> int:
    """Of distances: enough to tell them from the threshold."""
    return max(4, 1 - math.floor(math.log10(report.threshold_mm)))


def _regions(one: TargetReport, decimals: int) -> str:
    worst = sorted(one.regions.items(), key=lambda item: -item[1].max_mm)[:_REGIONS]
    return "worst regions: " + ", ".join(f"{name} {off.max_mm:.{decimals}f} mm" for name, off in worst)


def _at_limits(name: str, one: TargetReport) -> list[str]:
    return [f"{name}: stopped by limits: {_names(one.at_limits)}"] if one.at_limits else []


def _names(names: Sequence[str]) -> str:
    some = ", ".join(name.rpartition("/")[2] for name in names[:_SHOWN])
    return f"{len(names)} ({some}{', ...' if len(names) > _SHOWN else ''})"
