"""What became of the photos."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from facepipe.core.reports import Report, unsaid


@dataclass(frozen=True, kw_only=True)
class ScanPhotosReport(Report):
    """How a scan came out of photos. Lengths are in `unit`; None: the scale is unknown, they are of the scan's own."""

    photos_used: tuple[str, ...] = ()
    photos_unused: tuple[str, ...] = ()  # could not be placed
    cameras: str = "found"  # or "given"
    unit: str | None = None  # mm, cm or m
    reprojection_px: float = 0.0  # mean distance of matched points from where photos show them
    matched_points: int = 0
    pairs: int = 0  # of photos, whose depth was found together
    spacing: float = 0.0  # distance of the dense points
    dense_points: int = 0  # after cleaning
    consistency: float = 0.0  # median distance between the surfaces that different photos give, along the view
    consistency_px: float = 0.0  # the same in widths of a pixel on the skin
    points: int = 0  # of the scan
    triangles: int = 0
    landmarks: int = 0  # of 68
    markers: int = 0
    seconds: float = 0.0
    used: Any = unsaid()  # the `Cameras` of the photos that were used
