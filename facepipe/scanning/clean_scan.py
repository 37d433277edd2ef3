"""A scan as registration wants it: mended, with outward normals, and with its border known."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from facepipe.core.arrays import BoolArray, IntArray
from facepipe.core.errors import FacepipeError
from facepipe.core.reports import Report
from facepipe.declare import check_ranges, option
from facepipe.geometry.polygons import merge_points, point_normals
from facepipe.geometry.scan_surface import SurfaceReport, clean_surface, cloud_normals
from facepipe.scans import Scan


@dataclass(frozen=True, kw_only=True)
class CleanScanReport(Report):
    """What was mended."""

    points: int  # that stay
    triangles: int
    lone_points: int = 0  # of a cloud, far from all others, dropped
    turned_normals: bool = False  # the file's normals pointed inward
    surface: SurfaceReport = field(default_factory=SurfaceReport)


@dataclass(frozen=True, kw_only=True)
class CleanedScan:
    """A mended scan with normals."""

    scan: Scan  # normals are there always
    border: BoolArray  # (n,) points beside a hole or the scan's end; all False in clouds
    component: IntArray  # (n,) connected piece of each point, the largest 0; all 0 in clouds
    source: IntArray  # (n,) the point of the scan that each one is
    report: CleanScanReport


@dataclass(frozen=True, kw_only=True)
class CleanScan:
    """Mends a scan.

    Surfaces: see `clean_surface`; normals are made anew of the mended triangles. Clouds stay clouds: their normals are
    the file's, or else those of the planes through neighbours.
    """

    smallest: float = option(0.01, "pieces with less of the largest one's area are dropped", 0.0, 1.0)
    neighbours: int = option(16, "points, the nearest, that give the tangent plane at a point of a cloud", 3, 100)

    def __call__(self, scan: Scan) -> CleanedScan:
        """Mend `scan`.

        :raises InputError: options out of range, or no surface in it
        """
        check_ranges(self)
        try:
            return self._cloud(scan) if scan.is_cloud else self._surface(scan)
        except FacepipeError as error:
            raise error.under(scan.name) from None

    def _surface(self, scan: Scan) -> CleanedScan:
        # Normals are made anew: the file's are of points that may have been merged, or of triangles turned.
        cleaned = clean_surface(scan.points, scan.triangles, smallest=self.smallest)
        mended = replace(
            scan,
            points=cleaned.points,
            triangles=cleaned.triangles,
            normals=point_normals(cleaned.points, cleaned.triangles),
            colors=None if scan.colors is None else scan.colors[cleaned.source],
            texture=None,
        )
        lines, found = [], cleaned.report
        if found.small_components:
            lines.append(f"{found.small_components} small pieces dropped ({found.small_triangles} triangles)")
        if found.non_manifold_edges:
            lines.append(f"{found.non_manifold_edges} edges of more than two triangles cut open")
        if found.one_sided_edges:
            lines.append(f"a one-sided surface cut open along {found.one_sided_edges} edges")
        if found.turned_triangles:
            lines.append(f"{found.turned_triangles} triangles turned to face outward")
        report = CleanScanReport(
            points=len(cleaned.points),
            triangles=len(cleaned.triangles),
            surface=found,
            warnings=tuple(lines),
        )
        return CleanedScan(
            scan=mended,
            border=cleaned.border,
            component=cleaned.component,
            source=cleaned.source,
            report=report,
        )

    def _cloud(self, scan: Scan) -> CleanedScan:
        first, _ = merge_points(scan.points)
        points = scan.points[first]
        cloud = cloud_normals(points, self.neighbours)
        kept, normals, turned = ~cloud.lone, cloud.normals, False
        # A scanner knows which side it saw: the planes of neighbours only tell whether all normals point inward.
        if scan.normals is not None:
            normals = scan.normals[first]
            turned = bool(np.einsum("ni,ni->n", normals, cloud.normals).mean() < 0)
            normals = -normals if turned else normals
        mended = replace(
            scan,
            points=points[kept],
            normals=normals[kept],
            colors=None if scan.colors is None else scan.colors[first][kept],
        )
        count = int(kept.sum())
        report = CleanScanReport(
            points=count,
            triangles=0,
            lone_points=len(points) - count,
            turned_normals=turned,
            surface=SurfaceReport(merged_points=len(scan.points) - len(points)),
        )
        border, component = np.zeros(count, bool), np.zeros(count, np.int64)
        source = np.asarray(first)[kept]
        return CleanedScan(scan=mended, border=border, component=component, source=source, report=report)
