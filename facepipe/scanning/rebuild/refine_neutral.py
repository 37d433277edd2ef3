"""A neutral, or regions of it, drawn onto its scan: local refinement (document S13, the first constraint)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.names import first_names
from facepipe.core.reports import Report
from facepipe.core.threads import one_thread
from facepipe.geometry.local_refinement import RefinementOptions, refine_locally
from facepipe.geometry.polygons import flipped_triangles
from facepipe.geometry.registration import Registered, RegistrationOptions, View
from facepipe.geometry.similarity import Similarity
from facepipe.kinds import found_of
from facepipe.parts import Recipe
from facepipe.scanning.database import Quality
from facepipe.scanning.rebuild.fit_neutral import landmark_anchors
from facepipe.scanning.rebuild.options import RefineNeutralOptions
from facepipe.scanning.rebuild.register_scans import neutral_place, neutral_surface
from facepipe.scanning.rebuild.scan_fit import row_distances, scan_target
from facepipe.scanning.rebuild.template import Template
from facepipe.scans import Scan, ScanLandmarks

_MUCH = 0.5  # of the points that a scan can show
_STILL = 1e-9  # mm: rounding


@dataclass(frozen=True, kw_only=True)
class RefinedNeutral:
    """A neutral, closer to its scan."""

    points: FloatArray  # (n, 3) whole points
    place: Similarity  # from the scan's coordinates to those
    report: RefineReport


@dataclass(frozen=True, kw_only=True)
class RefineNeutral:
    """Draws a neutral that lies about right on its scan closer to it, where it may follow.

    Changes of neighbouring triangles are kept alike, nearest points and landmarks pull: the document's first
    constraint. Loose parts (eyeballs, teeth) that may follow go with the skin around them, the others stay.
    """

    options: RefineNeutralOptions = field(default_factory=RefineNeutralOptions)

    @one_thread()
    def __call__(
        self,
        template: Template,
        points: FloatArray,
        scan: Scan,
        landmarks: ScanLandmarks,
        place: Similarity | None = None,
        weights: FloatArray | None = None,
        expression: FloatArray | None = None,
        *,
        flipped: int = 0,
        progress: Callable[[int], None] = lambda step: None,
    ) -> RefinedNeutral:
        """Refine a neutral.

        :param points: (n, 3) whole points of the neutral, millimetres
        :param place: from the scan's coordinates to those; None: it is found by landmarks and the surface,
            that of what stays if it is half of the face
        :param weights: (n,) 0 to 1, the share of the way that each point may go; those of 0 stay to the bit. None: all
            may go all of it
        :param expression: (n, 3) whole delta that the scan shows besides, such as closed eyes: it stays off the result
        :param flipped: triangles that were turned over before, for the quality
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
        lies = _place(template, shown, scan, landmarks, rows) if place is None else place
        target, mended = scan_target(scan)
        places = np.array(landmarks.points, np.float64)
        places[rows[template.landmarks] <= 0.0] = np.nan
        anchors = landmark_anchors(template, replace(landmarks, points=places))
        view = View(scan=target, anchors=anchors, start=lies, name=f"{scan.name} -> scan")
        surface = neutral_surface(template, shown)
        solution = refine_locally(surface, view, rows, _refinement(self.options), progress)
        result = BeforeAndAfter(
            template=template,
            before=shown,
            after=_whole(template, shown, solution.points, follow),
            rows=rows,
            matched=tuple(
                row_distances(template, one, target, lies, self.options.reach_mm)
                for one in (surface.base, solution.points)
            ),
        )
        report = result.report(scan.name, solution, anchors.names, flipped, (*scan.warnings, *mended))
        moved = result.after - shown
        # (points + expression) - expression rounds: points that stayed are taken as they were, to the bit.
        refined = np.where((moved == 0.0).all(axis=1, keepdims=True), points, points + moved)
        return RefinedNeutral(points=refined, place=lies, report=report)


def _place(
    template: Template, points: FloatArray, scan: Scan, landmarks: ScanLandmarks, follow: FloatArray
) -> Similarity:
    """Where the scan lies, by what stays if that is much of the face: what is to be refined is not yet right."""
    staying = template.seen[follow[template.seen] <= 0.0]
    by = staying if len(staying) >= _MUCH * len(template.seen) else None
    return neutral_place(template, points, scan, landmarks, by)


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


def _refinement(options: RefineNeutralOptions) -> RefinementOptions:
    """The same for the solver."""
    matching = RegistrationOptions(anchor_sigma_mm=options.landmark_sigma_mm, reach_mm=options.reach_mm)
    return RefinementOptions(detail_mm=options.detail_mm, drift_mm=options.drift_mm, matching=matching)


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
    outliers: tuple[str, ...]  # landmarks that are ignored
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
        self, scan: str, solution: Registered, names: tuple[str, ...], flipped: int, warnings: tuple[str, ...]
    ) -> RefineReport:
        """What changed.

        :param names: of the landmarks
        :param flipped: triangles that were turned over before
        """
        free = self.rows > 0.0
        before, after = (np.where(free, one, np.nan) for one in self.matched)
        moved = np.linalg.norm(self.after - self.before, axis=1)[self.template.rows[free]]
        turned = int(flipped_triangles(self.before, self.after, self.template.topology.triangles).sum())
        outliers = tuple(names[number] for number in solution.outliers)
        off = solution.anchor_distances
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
            steps=solution.steps,
            quality=self._quality(flipped + turned),
            warnings=(*warnings, *_warnings(scan, outliers, turned)),
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


def _warnings(scan: str, outliers: tuple[str, ...], turned: int) -> Iterator[str]:
    if outliers:
        some = first_names(outliers, 6)
        yield f"{scan}: {len(outliers)} landmarks ignored as outliers: {some}"
    if turned:
        yield f"{turned} triangles are turned over, expected none: a larger --detail-mm folds less"
