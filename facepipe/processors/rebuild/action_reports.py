"""What the actions of a rebuild report beside what their fits report: limits that were missed, and what is drawn."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

from facepipe.core.reports import Report, not_in_json
from facepipe.processors.database import Quality, QualityLimits, misses
from facepipe.processors.rebuild.fit_neutral import NeutralReport
from facepipe.processors.rebuild.refine_neutral import RefineReport
from facepipe.processors.rebuild.register_scans import CompositeReport
from facepipe.processors.rebuild.scan_fit import FaceOnScan, ScanFit
from facepipe.processors.rebuild.split_expressions import SplitReport

J = TypeVar("J", bound="Judged")


@dataclass(frozen=True, kw_only=True)
class Judged(Report):
    """A report held against limits."""

    missed: tuple[str, ...] = ()  # a line for each limit
    picture: FaceOnScan | None = not_in_json()

    @classmethod
    def from_report(cls: type[J], report: Report, warnings: tuple[str, ...], missed: tuple[str, ...], **more: Any) -> J:
        """`report` with what it lacks.

        :param warnings: all but the lines of what was missed
        """
        return cls(**{**vars(report), "warnings": (*warnings, *missed), "missed": missed, **more})


@dataclass(frozen=True, kw_only=True)
class FitNeutralReport(Judged, NeutralReport):
    """What `facepipe fit-neutral` did."""

    textures: Mapping[str, tuple[str, ...]] = field(default_factory=dict)  # file -> the materials that show it
    colored: float = 0.0  # share of the skin's outside whose colours the scan shows


@dataclass(frozen=True, kw_only=True)
class RefineNeutralReport(Judged, RefineReport):
    """What `facepipe refine-neutral` did."""

    regions: tuple[str, ...]  # that could follow; none: all


@dataclass(frozen=True, kw_only=True)
class RegisterScanReport(Judged, CompositeReport):
    """What `facepipe register-scan` did."""

    name: str  # of the shape


@dataclass(frozen=True, kw_only=True)
class SplitShapesReport(Judged, SplitReport):
    """What `facepipe split-shapes` did."""

    flipped_triangles: int  # in some shape, where the personal template's has them upright


def fit_misses(fit: ScanFit) -> tuple[str, ...]:
    """A line for each limit that a face misses on its scan; triangles that turn over are counted of shapes."""
    numbers = {name: getattr(fit, name) for name in ("surface_mean_mm", "surface_p95_mm", "coverage")}
    return misses(Quality(**numbers, flipped_triangles=0), QualityLimits())
