"""One scan in a registration: where it lies, what it shows, how far to trust it, and what pulls in the next step."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.errors import FitError
from facepipe.geometry.closest_points import closest_places
from facepipe.geometry.polygons import point_normals
from facepipe.geometry.registration.options import RegistrationOptions
from facepipe.geometry.registration.step import Pull
from facepipe.geometry.registration.surface import Anchors, DeformableSurface, Shown
from facepipe.geometry.registration.target import Matches, ScanTarget
from facepipe.geometry.similarity import Similarity
from facepipe.geometry.vectors import unit_vectors

_FEWEST_MATCHES = 50  # matches
_ANCHOR_OUTLIER = 4.0  # mm, and four times the median: further off, an anchor is reported as an outlier
_ANCHOR_BLUNDER = 25.0  # mm, and five times the median: further off from the start, it lies on another part of the face


@dataclass(frozen=True, kw_only=True)
class View:
    """One scan of a surface."""

    scan: ScanTarget
    anchors: Anchors  # in the scan's own coordinates
    start: Similarity  # from those to the face's, about right
    shown: Shown | None = None  # what it shows besides the surface
    sigmas: FloatArray | None = None  # (n,) mm, of the points' distances; None: all alike, that of the options
    name: str = "scan"  # what errors call it


@dataclass(frozen=True, kw_only=True)
class Registered:
    """A face on a scan."""

    points: FloatArray  # (n, 3) what the scan shows
    coefficients: FloatArray  # (k,) of the surface
    residual: FloatArray  # (n, 3) of the surface
    weights: FloatArray  # of what the scan shows besides the surface
    place: Similarity  # from the scan's own coordinates to the face's
    matched: BoolArray  # (n,) points that have a match
    distances: FloatArray  # (n,) of matched points from the scan's surface, NaN elsewhere
    anchor_distances: FloatArray  # (l,)
    anchor_slides: FloatArray  # (l,) the part of these that lies along the surface
    outliers: tuple[int, ...]  # anchors that lie off
    steps: int


@dataclass(frozen=True, kw_only=True)
class Demand:
    """Limits of matches in one step, and the areas that count."""

    reach: float  # mm
    huber: float  # mm
    areas: FloatArray  # (m,) mm^2 that each seen point stands for
    roughly: bool  # the nearest points instead of places


class ViewState:
    """The state of one scan between steps."""

    def __init__(self, view: View, surface: DeformableSurface, around: Any, options: RegistrationOptions) -> None:
        self._scan, self._options, self._sigmas, self._name = view.scan, options, view.sigmas, view.name
        self._anchors, self._place = _moved(view.anchors, view.start), view.start
        self.spread = view.anchors.matrix(len(surface.base)) @ around
        self._shown = view.shown or Shown.nothing(len(surface.base))
        self._weights = self._shown.expected.copy()

    def points(self, points: FloatArray) -> FloatArray:
        """(n, 3) what the scan shows of the surface's points."""
        return np.asarray(points + np.tensordot(self._weights, self._shown.modes, axes=1))

    def pull(self, surface: DeformableSurface, points: FloatArray, demand: Demand) -> Pull:
        """The matches and anchors that pull at the surface now.

        :param points: (n, 3) of the surface
        :raises FitError: hardly a point of the face finds a place on the scan
        """
        points, options, seen = self.points(points), self._options, surface.seen
        matches = self._matches(surface, points, demand.reach, roughly=demand.roughly)
        fewest = min(_FEWEST_MATCHES, (len(seen) + 1) // 2)
        if np.count_nonzero(matches.kept) < fewest:
            what = f"{np.count_nonzero(matches.kept)} points of the face find a place on it"
            raise FitError(self._name, f"{what}, expected {fewest} or more: does it show this face?")
        apart = np.abs(np.einsum("mi,mi->m", points[seen] - matches.places, matches.normals))
        sigmas = np.full(len(seen), options.surface_sigma_mm) if self._sigmas is None else self._sigmas[seen]
        off = np.linalg.norm(self._anchors.places(points) - self._anchors.targets, axis=1)
        trusted = rough_trust(off, 3.0 * demand.huber) if demand.huber > options.huber_mm else anchor_trust(off)
        return Pull(
            seen=seen,
            matches=matches,
            # by area: points of the head in the box stand for 6 mm^2 each at the lips, and for 17 at the jaw
            weights=matches.kept * demand.areas / sigmas**2 * huber_weights(apart, demand.huber),
            anchors=self._anchors,
            anchor_weights=trusted / self._anchors.variances(options.anchor_sigma_mm),
            spread=self.spread,
            scale=options.scale,
            shown=self._shown,
        )

    def advance(self, move: Similarity, weights: FloatArray) -> None:
        """Go where a step leads."""
        self._anchors, self._place, self._weights = _moved(self._anchors, move), _after(self._place, move), weights

    def registered(
        self, surface: DeformableSurface, coefficients: FloatArray, residual: FloatArray, steps: int
    ) -> Registered:
        """The face on the scan after the last step."""
        points, seen = self.points(surface.points(coefficients, residual)), surface.seen
        matches = self._matches(surface, points, self._options.reach_mm)
        matched, distances = np.zeros(len(points), bool), np.full(len(points), np.nan)
        matched[seen] = matches.kept
        distances[seen[matches.kept]] = matches.distances[matches.kept]
        away = self._anchors.places(points) - self._anchors.targets
        off = np.linalg.norm(away, axis=1)
        across = unit_vectors(self._anchors.places(point_normals(points, surface.triangles)))
        slides = away - np.einsum("li,li->l", away, across)[:, None] * across
        return Registered(
            points=points,
            coefficients=coefficients,
            residual=residual,
            weights=self._weights,
            place=self._place,
            matched=matched,
            distances=distances,
            anchor_distances=off,
            anchor_slides=np.linalg.norm(slides, axis=1),
            outliers=tuple(np.flatnonzero(off > farthest_anchor(off)).tolist()),
            steps=steps,
        )

    def _matches(
        self, surface: DeformableSurface, points: FloatArray, reach: float, *, roughly: bool = False
    ) -> Matches:
        seen = surface.seen
        normals = point_normals(points, surface.triangles)[seen]
        matches = self._scan.matches(points[seen], normals, reach, self._options.angle, self._place, roughly=roughly)
        wrong = across(surface.labels, seen, points, surface.triangles, matches)
        return replace(matches, kept=matches.kept & ~wrong)


def _moved(anchors: Anchors, by: Similarity) -> Anchors:
    return replace(anchors, targets=by.apply(anchors.targets))


def _after(first: Similarity, then: Similarity) -> Similarity:
    return Similarity(
        rotation=then.rotation @ first.rotation,
        translation=then.apply(first.translation[None])[0],
        scale=then.scale * first.scale,
    )


def across(labels: IntArray, seen: IntArray, points: FloatArray, triangles: IntArray, matches: Matches) -> BoolArray:
    """(m,) matches of a lip or lid that lie on the other one, judged by the face as it is now.

    :param labels: (n,) or none: points of +a and -a never correspond
    :param seen: (m,) points that `matches` are of
    """
    wrong = np.zeros(len(seen), bool)
    if not len(labels):
        return wrong
    own_labels, corners = labels[seen], labels[triangles]
    rows = np.flatnonzero((own_labels != 0) & matches.kept)
    marked = np.flatnonzero((corners != 0).all(axis=1) & (corners == corners[:, :1]).all(axis=1))
    if len(rows) and len(marked):
        places = closest_places(matches.places[rows], points, triangles[marked])
        wrong[rows] = corners[marked[places.triangles], 0] == -own_labels[rows]
    return wrong


def huber_weights(distances: FloatArray, limits: FloatArray | float) -> FloatArray:
    """Weights of Huber's loss, ``limit / max(distance, limit)``: linear beyond the limits."""
    return np.asarray(limits / np.maximum(distances, limits))


def farthest_anchor(off: FloatArray) -> float:
    """Distance beyond which an anchor is reported as an outlier."""
    return max(_ANCHOR_OUTLIER, 4.0 * float(np.median(off))) if len(off) else 0.0


def rough_trust(off: FloatArray, limit: float) -> FloatArray:
    """Huber's weights for the first steps, where even right anchors lie off. A blunder counts nothing: a few of them
    would shrink the scan and bend the model to meet it."""
    farthest = max(_ANCHOR_BLUNDER, 5.0 * float(np.median(off))) if len(off) else 0.0
    return np.asarray(huber_weights(off, limit) * (off <= farthest))


def anchor_trust(off: FloatArray) -> FloatArray:
    """Tukey's weights ``(1 - (off / farthest)^2)^2``: an outlier counts nothing, others nearly in full."""
    return np.asarray(np.maximum(1.0 - (off / max(farthest_anchor(off), 1e-12)) ** 2, 0.0) ** 2)
