"""Reports of blends as text."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.cli.show import table

if TYPE_CHECKING:
    from facepipe.processors.blend import BlendReport
    from facepipe.processors.blend.match import MatchReport


def as_text(out: Path, report: BlendReport) -> str:
    """What was made, and how near it came to the edges that were asked for."""
    lines = [
        f"{out}: {len(report.sources)} source{'s' * (len(report.sources) != 1)}, {report.points:,} points, "
        f"{len(report.shapes)} shapes and inbetweens in {report.seconds:.2f} s",
        _deviations(report),
        *_shapes(report),
        f"flipped triangles: {report.flipped_triangles} in the neutral, "
        f"{sum(shape.flipped_triangles for shape in report.shapes.values())} in shapes",
    ]
    for title, names in (("left out, as some source lacks them", report.skipped), ("transferred", report.transferred)):
        lines += [f"{title}: {', '.join(names)}"] if names else []
    return "\n".join(lines)


def match_text(found: MatchReport, sources: Sequence[str]) -> str:
    """The weights that were found, a region a line."""
    rows: list[list[object]] = [["found weights", *sources]]
    for name, row in found.weights.regions.items():
        lock = found.weights.locked.get(name)
        rows.append([name, *(f"{one:.3f}" for one in row), *([f"locked to {lock}"] if lock else [])])
    rows.append(["default", *(f"{one:.3f}" for one in found.weights.default or ())])
    return f"{table(rows)}\nedges differ from the target's by {found.rms_mm:.4f} mm RMS, {found.max_mm:.4f} at most"


def _deviations(report: BlendReport) -> str:
    rows: list[list[object]] = [["edges off what was asked for, mm", "edges", "RMS", "p95", "max"]]
    for name, one in (*report.regions.items(), ("all", report.deviation)):
        numbers = (f"{value:.4f}" for value in (one.rms_mm, one.p95_mm, one.max_mm))
        rows.append([name, f"{one.edges:,}", *numbers])
    return table(rows)


def _shapes(report: BlendReport) -> list[str]:
    if not report.shapes:
        return []
    name, worst = max(report.shapes.items(), key=lambda item: item[1].border_step_mm)
    return [f"worst step at the border of a shape: {worst.border_step_mm:.4f} mm ({name})"]
