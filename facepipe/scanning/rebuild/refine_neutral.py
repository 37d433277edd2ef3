"""A neutral, or regions of it, drawn onto its scan: local refinement (document S13, the first constraint)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.names import first_names
from facepipe.core.threads import one_thread
from facepipe.geometry.local_refinement import refine_locally
from facepipe.geometry.polygons import flipped_triangles
from facepipe.geometry.registration import Registered, View
from facepipe.geometry.similarity import Similarity
from facepipe.kinds import found_of
from facepipe.parts import Recipe
from facepipe.scanning.database import Quality
from facepipe.scanning.rebuild.declared import Judged, RefineNeutralOptions
from facepipe.scanning.rebuild.fit_neutral import landmark_anchors
from facepipe.scanning.rebuild.register_scans import neutral_place, neutral_surface
from facepipe.scanning.rebuild.scan_fit import row_distances, scan_target
from facepipe.scanning.rebuild.template import Template
from facepipe.scans import Scan, ScanLandmarks

_MUCH = 0.5  # of the points that a scan can show
_STILL = 1e-9  # mm: rounding
_USUAL = RefineNeutralOptions()


@dataclass(frozen=True, kw_only=True)
class RefineNeutralReport(Judged):
    """What a refinement changed; distances are of points that may follow and that the scan shows."""

    scan: str
    points: int  # of the skin that may follow
    before_mean_mm: float  # distances from the scan's surface
    before_p95_mm: float
    surface_mean_mm: float
    surface_p95_mm: float
    coverage: float  # share 0..1 of the outside of what may follow that the scan shows
    landmark_mean_mm: float | None  # of landmarks in what may follow; None: there are none
    outliers: tuple[str, ...]  # landmarks that are ignored
    moved_mean_mm: float  # skin that may follow
    moved_max_mm: float
    flipped_triangles: int  # that the refinement turned over
    steps: int
    quality: Quality  # of the whole neutral now, what a database asks for
    regions: tuple[str, ...] = ()  # that could follow; none: all

    of_action: ClassVar[tuple[str, ...]] = ("regions",)


@one_thread()
def refine_neutral(
    template: Template,
    points: FloatArray,
    scan: Scan,
    landmarks: ScanLandmarks,
    place: Similarity | None = None,
    weights: FloatArray | None = None,
    expression: FloatArray | None = None,
    *,
    options: RefineNeutralOptions = _USUAL,
    flipped: int = 0,
    progress: Callable[[int], None] = lambda step: None,
) -> tuple[FloatArray, Similarity, RefineNeutralReport]:
    """A neutral that lies about right on its scan drawn closer to it, where it may follow.

    Changes of neighbouring triangles are kept alike, nearest points and landmarks pull: the document's first
    constraint. Loose parts (eyeballs, teeth) that may follow go with the skin around them, the others stay.

    :param points: (n, 3) whole points of the neutral, millimetres
    :param place: from the scan's coordinates to those; None: it is found by landmarks and the surface,
        that of what stays if it is half of the face
    :param weights: (n,) 0 to 1, the share of the way that each point may go; those of 0 stay to the bit. None: all
        may go all of it
    :param expression: (n, 3) whole delta that the scan shows besides, such as closed eyes: it stays off the result
    :param flipped: triangles that were turned over before, for the quality
    :return: (n, 3) whole points, the place of the scan, and what changed
    :raises InputError: weights of no point that a scan can show, too few landmarks to find the place by, or a scan
        that can't be used
    :raises FitError: a scan that does not show what may follow
    """
    points = np.asarray(points, np.float64)
    shown = points if expression is None else points + expression
    follow = np.ones(len(points)) if weights is None else np.asarray(weights, np.float64)
    rows = follow[template.rows]
    if not rows[template.seen].any():
        raise InputError(template.where, "a scan can show no point that may follow, expected some on the outside")
    if place is None:
        # by what stays if that is much of the face: what is to be refined is not yet right
        staying = template.seen[rows[template.seen] <= 0.0]
        by = staying if len(staying) >= _MUCH * len(template.seen) else None
        place = neutral_place(template, shown, scan, landmarks, by)
    target, mended = scan_target(scan)
    places = np.array(landmarks.points, np.float64)
    places[rows[template.landmarks] <= 0.0] = np.nan
    anchors = landmark_anchors(template, replace(landmarks, points=places))
    view = View(scan=target, anchors=anchors, start=place, name=f"{scan.name} -> scan")
    surface = neutral_surface(template, shown)
    solution = refine_locally(surface, view, rows, options.refinement, progress)
    after = _whole(template, shown, solution.points, follow)
    distances = [
        row_distances(template, one, target, place, options.reach_mm) for one in (surface.base, solution.points)
    ]
    lines = (*scan.warnings, *mended)
    report = _report(template, scan.name, solution, anchors.names, (shown, after), rows, distances, flipped, lines)
    moved = after - shown
    # (points + expression) - expression rounds: points that stayed are taken as they were, to the bit.
    return np.where((moved == 0.0).all(axis=1, keepdims=True), points, points + moved), place, report


def _report(
    template: Template,
    scan: str,
    solution: Registered,
    names: tuple[str, ...],
    points: tuple[FloatArray, FloatArray],
    rows: FloatArray,
    distances: Sequence[FloatArray],
    flipped: int,
    lines: tuple[str, ...],
) -> RefineNeutralReport:
    """What changed: whole points (n, 3), and distances (m,), NaN where the scan shows none, are before and after.

    :param rows: (m,) how far skin may follow
    """
    # NaN, not 0, where a row may not follow: means are over what could change.
    free, shows, face = rows > 0.0, np.isfinite(distances[1]), template.face
    before, after = (_mean_and_p95(np.where(free, one, np.nan)) for one in distances)
    whole = _mean_and_p95(distances[1])
    moved = np.linalg.norm(points[1] - points[0], axis=1)[template.rows[free]]
    turned = int(flipped_triangles(*points, template.topology.triangles).sum())
    outliers, off = tuple(names[number] for number in solution.outliers), solution.anchor_distances
    if outliers:
        lines = (*lines, f"{scan}: {len(outliers)} landmarks ignored as outliers: {first_names(outliers, 6)}")
    if turned:
        lines = (*lines, f"{turned} triangles are turned over, expected none: a larger --detail-mm folds less")
    return RefineNeutralReport(
        scan=scan,
        points=int(free.sum()),
        before_mean_mm=before[0],
        before_p95_mm=before[1],
        surface_mean_mm=after[0],
        surface_p95_mm=after[1],
        coverage=float(shows[template.seen[free[template.seen]]].mean()),
        landmark_mean_mm=float(off.mean()) if len(off) else None,
        outliers=outliers,
        moved_mean_mm=float(moved.mean()),
        moved_max_mm=float(moved.max()),
        flipped_triangles=turned,
        steps=solution.steps,
        quality=Quality(
            surface_mean_mm=whole[0],
            surface_p95_mm=whole[1],
            coverage=float(shows[face].mean()) if face.any() else 0.0,
            flipped_triangles=flipped + turned,
        ),
        warnings=lines,
    )


def _whole(template: Template, before: FloatArray, skin: FloatArray, follow: FloatArray) -> FloatArray:
    """(n, 3) whole points with the skin at `skin` (m, 3); what has not moved, and loose parts not all of which may
    follow, as they were to the bit."""
    result = template.whole(before, skin)
    part = template.stiff
    loose = part >= 0
    staying = np.zeros(int(part.max(initial=-1)) + 1, bool)
    staying[part[loose & (follow <= 0.0)]] = True
    kept = np.linalg.norm(result - before, axis=1) < _STILL
    kept[loose] |= staying[part[loose]]
    return np.where(kept[:, None], before, result)


def flipped_before(recipe: Recipe | None) -> int:
    """Triangles that a neutral has turned over by its recipe, 0 where that says nothing."""
    quality = found_of(recipe).get("quality")
    found = quality.get("flipped_triangles") if isinstance(quality, Mapping) else None
    return found if isinstance(found, int) and found > 0 else 0


def _mean_and_p95(distances: FloatArray) -> tuple[float, float]:
    """Mean and 95th percentile of what is known; 0 where nothing is."""
    known = distances[np.isfinite(distances)]
    return (float(known.mean()), float(np.percentile(known, 95))) if len(known) else (0.0, 0.0)
