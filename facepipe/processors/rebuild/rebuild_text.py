"""The report of a rebuild for people."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from facepipe.core.texts import table
from facepipe.processors.rebuild.rebuild_report import RebuildReport, refined_line

_SHOWN = 10  # shapes that the text names


def rebuild_text(report: RebuildReport) -> str:
    """Tables of scans and shapes, and a line for each thing besides."""
    lines = [table([("scan", "mean mm", "p95 mm", "face seen", "landmarks mm"), *_scans(report.stages)])]
    if "refined" in report.stages:
        lines.append(refined_line(report.stages["refined"]))
    if "shapes" in report.stages:
        lines += _shapes(**{name: report.stages["shapes"][name] for name in ("shapes", "unseen")})
    if report.reused:
        lines.append(f"reused: {', '.join(report.reused)}")
    if report.corrected:
        lines.append(f"corrected by hand: {', '.join(report.corrected)}")
    return "\n".join(lines)


def _scans(stages: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    for name, stage in stages.items():
        if "fit" in stage:
            fit = stage["fit"]
            distances = (f"{fit['surface_mean_mm']:.3f}", f"{fit['surface_p95_mm']:.3f}")
            seen = (f"{100 * fit['coverage']:.0f} %", f"{fit['landmark_mean_mm']:.2f}")
            yield (name.removeprefix("expressions/"), *distances, *seen)


def _shapes(shapes: Mapping[str, Any], unseen: list[str]) -> Iterator[str]:
    yield f"{len(shapes) - len(unseen)} of {len(shapes)} shapes told by the scans, the others the template's"
    told = sorted(set(shapes) - set(unseen), key=lambda name: (-shapes[name]["change_mm"], name))[:_SHOWN]
    rows: list[tuple[str, ...]] = [("changed most", "observed", "gain", "change mm", "scans")]
    for name in told:
        one = shapes[name]
        numbers = (f"{one['observed']:.2f}", f"{one['gain']:.2f}", f"{one['change_mm']:.2f}")
        rows.append((name, *numbers, " ".join(one["scans"])))
    if told:
        yield table(rows)
