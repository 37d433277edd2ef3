"""How databases are made, and what may be added to them: the quality gate of rebuilt faces."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from facepipe.core.errors import InputError
from facepipe.declare import check_ranges, from_json, option


@dataclass(frozen=True, kw_only=True)
class Quality:
    """What was measured of a rebuilt face."""

    surface_mean_mm: float  # mean distance from the face's points to the scan of its neutral
    surface_p95_mm: float  # 95th percentile of these
    coverage: float  # share 0..1 of the face area that the scan shows
    flipped_triangles: int  # of the neutral and its shapes, against what models and templates of them show

    def __post_init__(self) -> None:
        """:raises InputError: a number out of range"""
        for name in ("surface_mean_mm", "surface_p95_mm", "coverage", "flipped_triangles"):
            value = getattr(self, name)
            if not math.isfinite(value) or value < 0 or (name == "coverage" and value > 1):
                expected = "a share from 0 to 1" if name == "coverage" else "a finite number of 0 or more"
                raise InputError(f"quality -> {name}", f"{value}, expected {expected}")


@dataclass(frozen=True, kw_only=True)
class QualityLimits:
    """What a face must meet to be added."""

    max_surface_mean_mm: float = option(0.3, "largest mean distance from the scan of the neutral", 0.0, 1e3, "mm")
    max_surface_p95_mm: float = option(1.0, "largest 95th percentile of that distance", 0.0, 1e3, "mm")
    min_coverage: float = option(0.6, "least share of the face area that the scan shows", 0.0, 1.0)
    max_flipped_triangles: int = option(20, "most triangles turned over, in the neutral and its shapes", 0, 10**9)


def quality_from(values: object, where: str) -> Quality:
    """Measures of a JSON object ``{"surface_mean_mm": ..., "surface_p95_mm": ..., "coverage": ..., ...}``.

    It may stand under "quality" in a report of more.

    :raises InputError: a measure is missing, unknown or out of range
    """
    if isinstance(values, Mapping) and "quality" in values:
        where, values = f"{where} -> quality", values["quality"]
    return from_json(Quality, values, where)


def misses(quality: Quality, limits: QualityLimits) -> tuple[str, ...]:
    """A line for each limit that is missed.

    :raises InputError: a limit out of range
    """
    check_ranges(limits)
    above = (
        ("mean surface distance", quality.surface_mean_mm, limits.max_surface_mean_mm, " mm"),
        ("95th percentile of the surface distance", quality.surface_p95_mm, limits.max_surface_p95_mm, " mm"),
        ("flipped triangles", quality.flipped_triangles, limits.max_flipped_triangles, ""),
    )
    lines = [f"{what} {value:g}{unit}, expected at most {most:g}" for what, value, most, unit in above if value > most]
    if quality.coverage < limits.min_coverage:
        lines.append(f"coverage {quality.coverage:g}, expected at least {limits.min_coverage:g}")
    return tuple(lines)


@dataclass(frozen=True, kw_only=True)
class DatabaseOptions:
    """How a database is made."""

    tolerance_mm: float = option(
        0.1, "RMS error over all points to which each expression is held; less makes the file larger", 1e-4, 10.0, "mm"
    )


@dataclass(frozen=True, kw_only=True)
class AddOptions(QualityLimits):
    """What may be added to a database."""

    ignore_quality: bool = option(False, "add faces that miss the limits too; the history says so")
    drop_shapes: bool = option(
        False, "shapes of the database that a face lacks leave it; otherwise the face is refused"
    )


@dataclass(frozen=True, kw_only=True)
class FaceNames:
    """What faces are called in a database."""

    names: tuple[str, ...] = option(
        (),
        "names of the faces (default: those of their files)",
        parse=lambda words: tuple(name.strip() for word in words if word for name in word.split(",")),
        metavar="A,B,...",
        kept=False,
    )
