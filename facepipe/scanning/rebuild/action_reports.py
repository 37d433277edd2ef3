"""What the actions of a rebuild report beside what their fits report: limits that were missed, and what is drawn."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from facepipe.core.reports import Report, not_in_json, table
from facepipe.scanning.database import Quality, QualityLimits, misses
from facepipe.scanning.rebuild.fit_neutral import NeutralReport
from facepipe.scanning.rebuild.refine_neutral import RefineReport
from facepipe.scanning.rebuild.register_scans import CompositeReport
from facepipe.scanning.rebuild.scan_fit import FaceOnScan, ScanFit
from facepipe.scanning.rebuild.split_expressions import SplitReport

if TYPE_CHECKING:
    from facepipe.kinds import Job
    from facepipe.scanning.rebuild.rebuild_report import RebuildPictures

J = TypeVar("J", bound="Judged")
_SHOWN = 10  # shapes that a rebuild's text names


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
    hidden: tuple[str, ...] = ()  # materials of cards of brows, which the scan's colours show
    photos: Mapping[str, Any] = field(default_factory=dict)  # what `facepipe scan` reports of them


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


def slid_text(slid_mm: Mapping[str, float]) -> str:
    """How far parts of a face may have slid along a scan, as `ScanFit.slid_mm`."""
    return ", ".join(f"{part} {off:.2f} mm" for part, off in slid_mm.items())


def fit_misses(fit: ScanFit) -> tuple[str, ...]:
    """A line for each limit that a face misses on its scan; triangles that turn over are counted of shapes."""
    numbers = {name: getattr(fit, name) for name in ("surface_mean_mm", "surface_p95_mm", "coverage")}
    return misses(Quality(**numbers, flipped_triangles=0), QualityLimits())


@dataclass(frozen=True, kw_only=True)
class RebuildReport(Report):
    """What a rebuild did."""

    stages: Mapping[str, Any] = field(default_factory=dict)  # step -> its report
    quality: Mapping[str, Any] = field(default_factory=dict)  # how the neutral lies on its scan
    reused: tuple[str, ...] = ()  # steps whose results were there
    corrected: tuple[str, ...] = ()  # steps in whose place an artist put a mesh
    checks: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  # expression -> whether its scan belongs
    left_out: Mapping[str, str] = field(default_factory=dict)  # expression -> why its scan does not belong
    mouth: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  # shape -> how its inside comes through skin
    missed: tuple[str, ...] = ()  # a line for each limit, and each scan that was left out
    textures: Mapping[str, tuple[str, ...]] = field(default_factory=dict)  # file -> the materials that show it
    colored: float = 0.0  # share of the skin's outside whose colours the neutral's scan shows
    pictures: RebuildPictures | None = not_in_json()
    job: Job | None = not_in_json()

    def as_text(self, out: Path) -> str:
        """Tables of scans and shapes, and a line for each thing besides."""
        lines = [
            str(out),
            table([("scan", "mean mm", "p95 mm", "face seen", "landmarks mm"), *_scan_rows(self.stages)]),
        ]
        if "refined" in self.stages:
            lines.append(refined_line(self.stages["refined"]))
        if "shapes" in self.stages:
            report = self.stages["shapes"]
            lines += _shape_lines(report["shapes"], [*report["unseen"], *report["undecided"]])
            if report["undecided"]:
                lines.append(
                    f"hardly shown or not distinguished by the scans, the template's: {', '.join(report['undecided'])}"
                )
        if self.left_out:
            lines.append(f"left out: {', '.join(self.left_out)}")
        if self.textures:
            lines.append(f"skin in the scan's colours: {100 * self.colored:.1f} %")
        if self.reused:
            lines.append(f"reused: {', '.join(self.reused)}")
        if self.corrected:
            lines.append(f"corrected by hand: {', '.join(self.corrected)}")
        return "\n".join(lines)


def refined_line(report: Mapping[str, Any]) -> str:
    """What a refinement did to the neutral."""
    return (
        f"neutral refined at {report['points']} points: {report['before_mean_mm']:.3f} mm from the scan before (mean), "
        f"{report['surface_mean_mm']:.3f} mm now; moved {report['moved_mean_mm']:.2f} mm, at most "
        f"{report['moved_max_mm']:.2f} mm"
    )


def _scan_rows(steps: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    for name, step in steps.items():
        if "fit" in step:
            fit = step["fit"]
            distances = (f"{fit['surface_mean_mm']:.3f}", f"{fit['surface_p95_mm']:.3f}")
            seen = (f"{100 * fit['coverage']:.0f} %", f"{fit['landmark_mean_mm']:.2f}")
            yield (name.removeprefix("expressions/"), *distances, *seen)


def _shape_lines(shapes: Mapping[str, Any], unseen: list[str]) -> Iterator[str]:
    yield f"{len(shapes) - len(unseen)} of {len(shapes)} shapes shown by the scans, the others are the template's"
    shown = sorted(set(shapes) - set(unseen), key=lambda name: (-shapes[name]["change_mm"], name))[:_SHOWN]
    rows: list[tuple[str, ...]] = [("changed most", "observed", "gain", "change mm", "scans")]
    for name in shown:
        shape = shapes[name]
        numbers = (f"{shape['observed']:.2f}", f"{shape['gain']:.2f}", f"{shape['change_mm']:.2f}")
        rows.append((name, *numbers, " ".join(shape["scans"])))
    if shown:
        yield table(rows)
