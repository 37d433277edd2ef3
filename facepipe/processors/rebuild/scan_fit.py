"""A scan made ready to be fitted to, and how well a face lies on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from facepipe.geometry.registration import Registered, ScanTarget
from facepipe.processors.clean_scan import CleanScan
from facepipe.processors.rebuild.options import UNITS
from facepipe.scans import Scan

_ALIKE = 0.15  # a scale nearer than this to a unit's is told as that unit


@dataclass(frozen=True, kw_only=True)
class ScanFit:
    """How a face lies on a scan."""

    scan: str
    mm_per_unit: float  # of the scan's coordinates
    unit: str | None  # what that is nearest to; None where it is like no unit
    surface_mean_mm: float  # distances of matched points from the scan
    surface_p95_mm: float
    coverage: float  # share 0..1 of the face area that has a match
    landmark_mean_mm: float
    outliers: tuple[str, ...]  # landmarks and markers that lie off
    steps: int


def scan_target(scan: Scan) -> tuple[ScanTarget, tuple[str, ...]]:
    """A scan mended and with normals, and what was mended.

    :raises InputError: nothing to fit to
    """
    found = CleanScan()(scan)
    mended = found.scan
    told = tuple(f"{scan.name}: {line}" for line in found.report.warnings)
    if mended.is_cloud:
        return ScanTarget.of_cloud(mended.points, np.asarray(mended.normals)), told
    return ScanTarget.of_surface(mended.points, mended.triangles), told


def unit_of(mm_per_unit: float) -> str | None:
    """The unit that a scale is nearest to, within 15 %."""
    for name, size in UNITS.items():
        if abs(mm_per_unit / size - 1.0) <= _ALIKE:
            return name
    return None


def scan_fit(scan: str, found: Registered, face: npt.NDArray[np.bool_], names: tuple[str, ...]) -> ScanFit:
    """What to report of a registration.

    :param face: (m,) points of the face area
    :param names: of the anchors
    """
    distances = found.distances[np.isfinite(found.distances)]
    return ScanFit(
        scan=scan,
        mm_per_unit=found.place.scale,
        unit=unit_of(found.place.scale),
        surface_mean_mm=float(distances.mean()) if len(distances) else float("nan"),
        surface_p95_mm=float(np.percentile(distances, 95)) if len(distances) else float("nan"),
        coverage=float(found.matched[face].mean()) if face.any() else 0.0,
        landmark_mean_mm=float(found.anchor_distances.mean()) if len(found.anchor_distances) else float("nan"),
        outliers=tuple(names[number] for number in found.outliers),
        steps=found.steps,
    )
