"""What the refinement of a neutral changed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.reports import Report
from facepipe.geometry.polygons import flipped_triangles
from facepipe.geometry.registration import Registered
from facepipe.kinds import found_of
from facepipe.parts import Recipe
from facepipe.processors.database import Quality
from facepipe.processors.rebuild.template import Template


@dataclass(frozen=True, kw_only=True)
class RefineReport(Report):
    """What a refinement changed; distances are of points that may follow and that the scan shows."""

    scan: str
    points: int  # of the skin that may follow
    before_mean_mm: float  # distances from the scan's surface
    before_p95_mm: float
    surface_mean_mm: float
    surface_p95_mm: float
    coverage: float  # share 0..1 of the outside of what may follow that the scan shows
    landmark_mean_mm: float | None  # of landmarks in what may follow; None: there are none
    outliers: tuple[str, ...]  # landmarks that lie off, and don't count
    moved_mean_mm: float  # skin that may follow
    moved_max_mm: float
    flipped_triangles: int  # that the refinement turned over
    steps: int
    quality: Quality  # of the whole neutral now, what a database asks for


@dataclass(frozen=True, kw_only=True)
class BeforeAndAfter:
    """A neutral before and after."""

    template: Template
    before: FloatArray  # (n, 3)
    after: FloatArray  # (n, 3)
    rows: FloatArray  # (m,) how far skin may follow
    matched: tuple[FloatArray, ...]  # two of (m,): distances before and after, NaN where the scan doesn't show it

    def report(
        self, scan: str, found: Registered, names: tuple[str, ...], flipped: int, warnings: tuple[str, ...]
    ) -> RefineReport:
        """What changed.

        :param names: of the landmarks
        :param flipped: triangles that were turned over before
        """
        free = self.rows > 0.0
        before, after = (np.where(free, one, np.nan) for one in self.matched)
        moved = np.linalg.norm(self.after - self.before, axis=1)[self.template.rows[free]]
        turned = int(flipped_triangles(self.before, self.after, self.template.topology.triangles).sum())
        outliers = tuple(names[number] for number in found.outliers)
        off = found.anchor_distances
        seen = self.template.seen[free[self.template.seen]]
        return RefineReport(
            scan=scan,
            points=int(free.sum()),
            before_mean_mm=_mean(before),
            before_p95_mm=_p95(before),
            surface_mean_mm=_mean(after),
            surface_p95_mm=_p95(after),
            coverage=float(np.isfinite(after[seen]).mean()),
            landmark_mean_mm=float(off.mean()) if len(off) else None,
            outliers=outliers,
            moved_mean_mm=float(moved.mean()),
            moved_max_mm=float(moved.max()),
            flipped_triangles=turned,
            steps=found.steps,
            quality=self._quality(flipped + turned),
            warnings=(*warnings, *_said(scan, outliers, turned)),
        )

    def _quality(self, flipped: int) -> Quality:
        after, face = self.matched[1], self.template.face
        return Quality(
            surface_mean_mm=_mean(after),
            surface_p95_mm=_p95(after),
            coverage=float(np.isfinite(after[face]).mean()) if face.any() else 0.0,
            flipped_triangles=flipped,
        )


def flipped_before(recipe: Recipe | None) -> int:
    """Triangles that a neutral has turned over by its recipe, 0 where that says nothing."""
    quality = found_of(recipe).get("quality")
    found = quality.get("flipped_triangles") if isinstance(quality, Mapping) else None
    return found if isinstance(found, int) and found > 0 else 0


def _mean(distances: FloatArray) -> float:
    known = distances[np.isfinite(distances)]
    return float(known.mean()) if len(known) else 0.0


def _p95(distances: FloatArray) -> float:
    known = distances[np.isfinite(distances)]
    return float(np.percentile(known, 95)) if len(known) else 0.0


def _said(scan: str, outliers: tuple[str, ...], turned: int) -> Iterator[str]:
    if outliers:
        some = ", ".join(outliers[:6]) + (" ..." if len(outliers) > 6 else "")
        yield f"{scan}: {len(outliers)} landmarks lie off and don't count: {some}"
    if turned:
        yield f"{turned} triangles are turned over, expected none: a larger --detail-mm folds less"
