"""What `facepipe lod` prints."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from facepipe.core.texts import table
from facepipe.processors.lod.errors import Distances
from facepipe.processors.lod.make import LodReport


def lod_text(report: LodReport, out: Path) -> str:
    """The levels as a table."""
    rows: list[list[object]] = [
        ["level", "triangles", "of skin", "points", "mm off at rest", "shapes", "on the skin", "joints"]
    ]
    for one in report.levels:
        errors = one.errors
        rest, *moved = ({"rest": errors.rest}, errors.shapes, errors.skin_shapes, errors.joints)
        counts = (f"{count:,}" for count in (one.triangles, one.skin_triangles, one.points))
        rows.append([one.name, *counts, _worst(rest).partition(" (")[0], *map(_worst, moved)])
    said = [f"{out}: {report.triangles:,} triangles, and", table(rows), "mean / 95 % of the points, worst first"]
    for one in report.levels:
        for mesh, gone in one.errors.cards.items():
            away = f"{gone.mean_mm:.2f} / {gone.p95_mm:.2f} mm from those that stay"
            said.append(f"{one.name}: points of cards of {mesh} that are left out (in no error above): {away}")
    return "\n".join(said)


def _worst(distances: Mapping[str, Distances]) -> str:
    """The largest mean and 95th percentile, and whose they are."""
    if not distances:
        return "-"
    names = [max(distances, key=lambda name: getattr(distances[name], key)) for key in ("mean_mm", "p95_mm")]
    mean, p95 = distances[names[0]].mean_mm, distances[names[1]].p95_mm
    return f"{mean:.2f} / {p95:.2f} ({', '.join(dict.fromkeys(name.rpartition('/')[2] for name in names))})"
