"""Registration of a deformable face with a scan: matches and steps in turn, from coarse to fine."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from facepipe.errors import FitError
from facepipe.geometry.closest_points import closest_places
from facepipe.geometry.differences import cotangent_weights, incidence
from facepipe.geometry.polygons import point_areas, point_normals
from facepipe.geometry.registration.anchors import Anchors
from facepipe.geometry.registration.step import Pull, solve_model_step, solve_step
from facepipe.geometry.registration.surface import DeformableSurface
from facepipe.geometry.registration.target import Matches, ScanTarget
from facepipe.geometry.similarity import Similarity
from facepipe.threads import one_thread

FloatArray = npt.NDArray[np.floating]
BoolArray = npt.NDArray[np.bool_]

_STAGES = ((5.0, 4.0, 6, 0.3), (2.0, 2.0, 4, 0.5), (1.0, 1.0, 8, 0.05))
"""Factors of reach and Huber's distance, steps at most, and the RMS movement (mm) that ends a stage."""
_ENOUGH_MODES = 20  # a model that can come near by itself: the first stage is left to it, on some of the points
_SOME_POINTS = 3000
_FEWEST = 50  # matches
_ANCHOR_OUTLIER = 4.0  # mm, and four times the median: further off, an anchor is told


@dataclass(frozen=True, kw_only=True)
class RegistrationOptions:
    """What counts how much."""

    surface_sigma_mm: float = 0.3  # of the distances from the scan; matches count by area over its square
    huber_mm: float = 0.3  # distances beyond count linearly
    reach_mm: float = 4.0  # matches further off don't count, in the last stage
    angle: float = 0.84  # radians between normals, beyond which a match doesn't count
    anchor_sigma_mm: float = 0.16  # of landmarks and markers
    membrane: float = 6.0  # stiffness of the residual
    scale: bool = True  # the scan's size is not known


@dataclass(frozen=True, kw_only=True)
class Registered:
    """A face on its scan."""

    points: FloatArray  # (n, 3)
    coefficients: FloatArray  # (k,)
    residual: FloatArray  # (n, 3)
    place: Similarity  # from the scan's own coordinates to the face's
    matched: BoolArray  # (n,) points that have a match
    distances: FloatArray  # (n,) of matched points from the scan's surface, NaN elsewhere
    anchor_distances: FloatArray  # (l,)
    outliers: tuple[int, ...]  # anchors that lie off
    steps: int


def register(
    surface: DeformableSurface,
    scan: ScanTarget,
    anchors: Anchors,
    start: Similarity,
    options: RegistrationOptions | None = None,
    progress: Callable[[int], None] = lambda step: None,
) -> Registered:
    """Fit a face to a scan.

    Robust point-to-plane distances to the nearest places (Huber), anchors, the modes' prior and a membrane for the
    residual, minimised together (`step`). Source: face-model-from-scans, S13 steps 1 to 5 and the first constraint,
    in one system instead of one after another: the residual keeps what the modes can't show from bending them.

    :param anchors: in the scan's own coordinates
    :param start: from those to the face's, about right
    :raises FitError: hardly a point of the face finds a place on the scan
    """
    options = options or RegistrationOptions()
    with one_thread():
        state = _State(surface, scan, _moved(anchors, start), start, options)
        steps = _run(state, options, progress)
        return state.result(steps)


def _run(state: _State, options: RegistrationOptions, progress: Callable[[int], None]) -> int:
    """All stages; the number of steps."""
    steps = 0
    for stage, (widening, softening, most, still) in enumerate(_STAGES):
        by_model = stage == 0 and state.has_model
        for _ in range(most):
            steps += 1
            change = state.advance(options.reach_mm * widening, options.huber_mm * softening, by_model=by_model)
            progress(steps)
            if change < still:
                break
    return steps


class _State:
    """Where a registration is."""

    def __init__(
        self,
        surface: DeformableSurface,
        scan: ScanTarget,
        anchors: Anchors,
        place: Similarity,
        options: RegistrationOptions,
    ) -> None:
        self._surface, self._scan, self._anchors, self._place, self._options = surface, scan, anchors, place, options
        self._some = _thinned(surface)
        self._areas = point_areas(surface.base, surface.triangles)
        self._stiffness = _stiffness(surface, self._areas, options.membrane)
        self._spread = anchors.matrix(len(surface.base)) @ _around(surface)
        self._coefficients = surface.expected.copy()
        self._residual = np.zeros_like(surface.base)

    @property
    def has_model(self) -> bool:
        """Whether the modes can come near by themselves."""
        return len(self._surface.expected) >= _ENOUGH_MODES

    @property
    def points(self) -> FloatArray:
        return self._surface.points(self._coefficients, self._residual)

    def advance(self, reach: float, huber: float, *, by_model: bool = False) -> float:
        """One step; the RMS movement of seen points against the scan, in millimetres.

        :param by_model: coefficients and place alone, by some of the points
        """
        before = self.points
        surface = self._some if by_model else self._surface
        matches = self._matches(surface, before, reach, roughly=by_model)
        if np.count_nonzero(matches.kept) < min(_FEWEST, len(surface.seen)):
            what = f"{np.count_nonzero(matches.kept)} points of the face find a place on it"
            raise FitError("scan", f"{what}, expected {_FEWEST} or more: does it show this face?")
        pull = self._pull(surface, before, matches, huber)
        if by_model:
            step = solve_model_step(surface, pull, scale=self._options.scale)
        else:
            step = solve_step(surface, self._stiffness, pull, scale=self._options.scale)
        self._coefficients, self._residual = step.coefficients, step.residual
        self._anchors = _moved(self._anchors, step.move)
        self._place = _after(self._place, step.move)
        seen = self._surface.seen
        moved = self.points[seen] - step.move.apply(before[seen])
        return float(np.sqrt((moved**2).sum(axis=1).mean()))

    def result(self, steps: int) -> Registered:
        points = self.points
        matches = self._matches(self._surface, points, self._options.reach_mm)
        count, seen = len(points), self._surface.seen
        matched, distances = np.zeros(count, bool), np.full(count, np.nan)
        matched[seen] = matches.kept
        distances[seen[matches.kept]] = matches.distances[matches.kept]
        off = np.linalg.norm(self._anchors.places(points) - self._anchors.targets, axis=1)
        limit = _farthest(off)
        return Registered(
            points=points,
            coefficients=self._coefficients,
            residual=self._residual,
            place=self._place,
            matched=matched,
            distances=distances,
            anchor_distances=off,
            outliers=tuple(np.flatnonzero(off > limit).tolist()),
            steps=steps,
        )

    def _matches(
        self, surface: DeformableSurface, points: FloatArray, reach: float, *, roughly: bool = False
    ) -> Matches:
        seen = surface.seen
        normals = point_normals(points, surface.triangles)[seen]
        matches = self._scan.matches(points[seen], normals, reach, self._options.angle, self._place, roughly=roughly)
        return replace(matches, kept=matches.kept & ~_across(surface, points, matches))

    def _pull(self, surface: DeformableSurface, points: FloatArray, matches: Matches, huber: float) -> Pull:
        options, seen = self._options, surface.seen
        apart = np.abs(np.einsum("mi,mi->m", points[seen] - matches.places, matches.normals))
        areas = self._areas[seen] * (len(self._surface.seen) / max(len(seen), 1))  # each stands for its neighbours too
        weights = matches.kept * areas / options.surface_sigma_mm**2 * _robust(apart, huber)
        off = np.linalg.norm(self._anchors.places(points) - self._anchors.targets, axis=1)
        trusted = _robust(off, 3.0 * huber) if huber > options.huber_mm else _trusted(off)
        return Pull(
            matches=matches,
            weights=weights,
            anchors=self._anchors,
            anchor_weights=trusted / options.anchor_sigma_mm**2,
            spread=self._spread,
        )


def _around(surface: DeformableSurface) -> Any:
    """(n, n) sparse: means over the points around each. An anchor that pulled one point alone would draw a spike."""
    from scipy.sparse import csr_array, diags_array, identity

    count = len(surface.base)
    pairs, _ = cotangent_weights(surface.base, surface.triangles)
    both = np.concatenate([pairs, pairs[:, ::-1]])
    near = csr_array((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(count, count)) + identity(count)
    mean = diags_array(1.0 / near.sum(axis=1)) @ near
    return (mean @ mean).tocsr()


def _thinned(surface: DeformableSurface) -> DeformableSurface:
    """The same with some of its seen points, evenly taken."""
    return replace(surface, seen=surface.seen[:: max(1, len(surface.seen) // _SOME_POINTS)])


def _across(surface: DeformableSurface, points: FloatArray, matches: Matches) -> BoolArray:
    """(m,) matches of a lip or lid that lie on the other one, as far as the face as it is now tells."""
    across = np.zeros(len(surface.seen), bool)
    if not len(surface.labels):
        return across
    own, corners = surface.labels[surface.seen], surface.labels[surface.triangles]
    rows = np.flatnonzero((own != 0) & matches.kept)
    marked = np.flatnonzero((corners != 0).all(axis=1) & (corners == corners[:, :1]).all(axis=1))
    if len(rows) and len(marked):
        found = closest_places(matches.places[rows], points, surface.triangles[marked])
        across[rows] = corners[marked[found.triangles], 0] == -own[rows]
    return across


def _robust(distances: FloatArray, limit: float) -> FloatArray:
    """Weights of Huber's loss."""
    return np.asarray(limit / np.maximum(distances, limit))


def _farthest(off: FloatArray) -> float:
    """Distance beyond which an anchor is told as an outlier."""
    return max(_ANCHOR_OUTLIER, 4.0 * float(np.median(off))) if len(off) else 0.0


def _trusted(off: FloatArray) -> FloatArray:
    """Tukey's weights: an outlier says nothing, others nearly all that they have to say."""
    return np.asarray(np.maximum(1.0 - (off / max(_farthest(off), 1e-12)) ** 2, 0.0) ** 2)


def _stiffness(surface: DeformableSurface, areas: FloatArray, membrane: float) -> Any:
    from scipy.sparse import diags_array, identity, kron

    pairs, weights = cotangent_weights(surface.base, surface.triangles)
    differences = incidence(pairs, len(surface.base))
    resting = np.maximum(surface.held * areas, 1e-4 * max(float(areas.mean()), np.finfo(np.float64).tiny))
    bending = membrane * (differences.T @ diags_array(weights) @ differences)
    return kron(bending + diags_array(resting), identity(3)).tocsr()


def _moved(anchors: Anchors, by: Similarity) -> Anchors:
    return replace(anchors, targets=by.apply(anchors.targets))


def _after(first: Similarity, then: Similarity) -> Similarity:
    return Similarity(
        rotation=then.rotation @ first.rotation,
        translation=then.apply(first.translation[None])[0],
        scale=then.scale * first.scale,
    )
