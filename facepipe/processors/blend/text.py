"""Reports of blends as text."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.core.texts import table

if TYPE_CHECKING:
    from facepipe.processors.blend import BlendReport, MatchReport
    from facepipe.processors.blend.lids import LidContact

_SHOWN = 4  # names of a list


def as_text(out: Path, report: BlendReport) -> str:
    """What was made, and how near it came to the edges that were asked for."""
    lines = [
        f"{out}: {len(report.sources)} source{'s' * (len(report.sources) != 1)}, {report.points:,} points, "
        f"{len(report.shapes)} shapes and inbetweens in {report.seconds:.2f} s",
        _deviations(report),
        *_shapes(report),
        f"flipped triangles: {report.flipped_triangles} in the neutral, "
        f"{sum(shape.flipped_triangles for shape in report.shapes.values())} in shapes",
        f"loose parts: {report.loose_parts}; parts that keep their shape: {report.kept_parts}",
        *(_lids(name, contact) for name, contact in report.lids.items()),
        *_names("shapes transferred", report.transferred),
        *_names("shapes left out, as some source lacks them", report.skipped),
    ]
    return "\n".join(lines)


def match_text(found: MatchReport, sources: Sequence[str]) -> str:
    """The weights that were found, a region a line, and how near they come to the target."""
    rows: list[list[object]] = [["found weights", *_short(sources)]]
    for name, row in found.weights.regions.items():
        lock = found.weights.locked.get(name)
        rows.append([name, *(f"{one:.3f}" for one in row), *([f"locked to {lock}"] if lock else [])])
    rows.append(["default", *(f"{one:.3f}" for one in found.weights.default or ())])
    return f"{table(rows)}\nedges differ from the target's by {found.rms_mm:.4f} mm RMS, {found.max_mm:.4f} mm at most"


def _short(paths: Sequence[str]) -> Sequence[str]:
    """File names where they tell the paths apart."""
    names = [Path(path).name for path in paths]
    return names if len(set(names)) == len(names) else paths


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


def _lids(name: str, contact: LidContact) -> str:
    text = f"{name}: lids cut in by {_depth(contact.depth_mm, contact.sources_mm)}"
    if contact.worst_shape is None:
        return text
    return f"{text}; at worst {_depth(contact.worst_depth_mm, contact.worst_sources_mm)} with {contact.worst_shape}"


def _depth(depth: float, sources: Sequence[float]) -> str:
    return f"{depth:.2f} mm (sources {', '.join(f'{one:.2f}' for one in sources)})"


def _names(title: str, names: Sequence[str]) -> list[str]:
    some = ", ".join(names[:_SHOWN]) + (", ..." if len(names) > _SHOWN else "")
    return [f"{title}: {len(names)} ({some})"] if names else []
