"""A scan as a registration sees it, and one step: coefficients, place and residual solved together from matches.

With modes C, a residual d, and a scan that turns by ω, moves by t and grows by s about its centre, the distance of a
point from the plane of its match p is linear in all of them:

    n . (base + C b + d - p - ω x p - t - s p)

The residual has three unknowns a point, b and the scan's place 60 to 70 in all. For fixed b, ω, t, s the residual
solves one sparse system ``K d = r_0 - R u`` with u for all of these; K is factored once and solved for a right-hand
side of each. Put back, that leaves ``(N - R^T K^-1 R) u = n_0 - R^T K^-1 r_0`` of the normal equations' N and n_0
(Schur complement), a dense system of the few. Several scans of one face share b and d; each has its own place, and
weights of what else it shows: an expression.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.errors import FitError
from facepipe.geometry.closest_points import closest_places
from facepipe.geometry.dissection import Dissection, FrontalFactor
from facepipe.geometry.gradient_system import cotangent_weights, incidence
from facepipe.geometry.options import RegistrationOptions
from facepipe.geometry.polygons import point_normals
from facepipe.geometry.registration.surface import Anchors, DeformableSurface, Matches, ScanTarget, Shown
from facepipe.geometry.similarity import Similarity
from facepipe.geometry.vectors import unit_vectors

_UNDETERMINED_HOLD = 1e-9  # share of a place's own curvature that keeps what nothing determines from moving
_FEWEST_MATCHES = 50  # matches
_ANCHOR_OUTLIER = 4.0  # mm, and four times the median: further off, an anchor is reported as an outlier
_ANCHOR_BLUNDER = 25.0  # mm, and five times the median: further off from the start, it lies on another part of the face


@dataclass(frozen=True, kw_only=True)
class Pull:
    """What pulls at the surface in one step: the matches and anchors of one scan."""

    seen: IntArray  # (m,) points of the surface that have matches
    matches: Matches  # of those
    weights: FloatArray  # (m,) of the matches
    anchors: Anchors
    anchor_weights: FloatArray  # (l,)
    spread: Any  # (l, n) sparse: the residual's part in the anchors, taken over the points around
    scale: bool  # whether the scan may grow
    shown: Shown  # what it shows besides the surface


@dataclass(frozen=True, kw_only=True)
class Step:
    """The result of a step."""

    coefficients: FloatArray  # (k,)
    residual: FloatArray  # (n, 3)
    moves: tuple[Similarity, ...]  # of the scans
    weights: tuple[FloatArray, ...]  # of what they show besides the surface


def solve_step(surface: DeformableSurface, membrane: Membrane, pulls: Sequence[Pull]) -> Step:
    """The least-squares step of all unknowns."""
    rows = [_Rows.from_pull(surface, pull) for pull in pulls]
    system = _System.from_rows(surface, rows)
    if len(rows) == 1:
        right = rows[0].right(len(surface.base))
    else:
        right = np.zeros((3 * len(surface.base), 1 + system.count))
        for row, columns in zip(rows, system.columns, strict=True):
            right[:, columns] += row.right(len(surface.base))
    # R^T K^-1 R is a product of L^-1 R with itself: all but one right-hand side are solved halfway
    factor = membrane.factor(pulls)
    halfway = factor.forward(right)
    unknown = system.solve(halfway.T @ halfway)
    residual = factor.backward(halfway[:, :1] - halfway[:, 1:] @ unknown[:, None])
    return system.step(unknown, residual.reshape(surface.base.shape))


def solve_model_step(surface: DeformableSurface, pulls: Sequence[Pull]) -> Step:
    """The least-squares step of all but the residual."""
    system = _System.from_rows(surface, [_Rows.from_pull(surface, pull) for pull in pulls])
    return system.step(system.solve(0.0), np.zeros_like(surface.base))


@dataclass(frozen=True, kw_only=True)
class _Rows:
    """Equations of one scan: columns are the offset, coefficients, own weights, and the scan's place."""

    pull: Pull
    planes: FloatArray  # (m, 1 + k + q)
    fixed: FloatArray  # (l, 3, 1 + k + q) of the anchors
    centre: FloatArray  # (3,) the scan turns and grows about

    @classmethod
    def from_pull(cls, surface: DeformableSurface, pull: Pull) -> _Rows:
        centre = pull.matches.places.mean(axis=0)
        # how far the base is from planes and anchors, and what each unknown moves points and these apart
        matches, seen, normals, anchors = pull.matches, pull.seen, pull.matches.normals, pull.anchors
        local, around = matches.places - centre, anchors.targets - centre
        planes: list[FloatArray] = [np.einsum("mi,mi->m", matches.places - surface.base[seen], normals)[:, None]]
        fixed: list[FloatArray] = [(anchors.targets - anchors.places(surface.base))[:, :, None]]
        for modes in (surface.modes, pull.shown.modes):
            planes.append(np.einsum("kmi,mi->mk", modes[:, seen], normals))
            fixed.append(anchors.places(modes.transpose(1, 2, 0)))
        planes += [-np.cross(local, normals), -normals]
        fixed.append(-np.stack([np.cross(axis, around) for axis in np.eye(3)], axis=2))
        fixed.append(-np.broadcast_to(np.eye(3), (len(around), 3, 3)))
        if pull.scale:
            planes.append(-np.einsum("mi,mi->m", local, normals)[:, None])
            fixed.append(-around[:, :, None])
        return cls(pull=pull, planes=np.concatenate(planes, axis=1), fixed=np.concatenate(fixed, axis=2), centre=centre)

    def normal(self) -> FloatArray:
        """(1 + k + q, 1 + k + q) normal equations of the view's own unknowns, and its distances with them."""
        found = self.planes.T @ (self.pull.weights[:, None] * self.planes)
        return np.asarray(found + np.einsum("lip,l,liq->pq", self.fixed, self.pull.anchor_weights, self.fixed))

    def right(self, count: int) -> FloatArray:
        """(3n, 1 + k + q) of the residual's equations."""
        pull, sides = self.pull, np.zeros((count, 3, self.planes.shape[1]))
        weighted = pull.weights[:, None] * self.planes
        for axis, along in enumerate(pull.matches.normals.T):
            sides[pull.seen, axis] = along[:, None] * weighted
        anchored, near = pull.anchor_weights[:, None, None] * self.fixed, np.unique(pull.spread.indices)
        drawn = pull.spread[:, near].T @ anchored.reshape(len(anchored), -1)
        sides[near] += drawn.reshape(len(near), *sides.shape[1:])
        return sides.reshape(3 * count, -1)


@dataclass(frozen=True, kw_only=True)
class _System:
    """The unknowns of all scans in one: coefficients first, then each scan's own."""

    rows: Sequence[_Rows]
    columns: Sequence[IntArray]  # of each scan: offset, coefficients and own
    modes: int
    precision: FloatArray  # (u,) prior of the unknowns, 0 for places
    expected: FloatArray  # (u,)

    @classmethod
    def from_rows(cls, surface: DeformableSurface, rows: Sequence[_Rows]) -> _System:
        modes, columns = len(surface.expected), []
        precision, expected = [surface.precision], [surface.expected]
        after = 1 + modes
        for row in rows:
            unknowns = row.planes.shape[1] - 1 - modes
            columns.append(np.concatenate([np.arange(1 + modes), np.arange(after, after + unknowns)]))
            shown = row.pull.shown
            place = np.zeros(unknowns - len(shown.expected))
            precision += [shown.precision, place]
            expected += [shown.expected, place]
            after += unknowns
        prior, mean = np.concatenate(precision), np.concatenate(expected)
        return cls(rows=rows, columns=columns, modes=modes, precision=prior, expected=mean)

    @property
    def count(self) -> int:
        """Unknowns but the residual."""
        return len(self.expected)

    def solve(self, by_residual: FloatArray | float) -> FloatArray:
        """(u,) unknowns, where the residual takes up `by_residual` (1 + u, 1 + u) of the normal matrix."""
        normal = np.zeros((1 + self.count, 1 + self.count))
        for row, columns in zip(self.rows, self.columns, strict=True):
            normal[np.ix_(columns, columns)] += row.normal()
        normal -= by_residual
        matrix, right = normal[1:, 1:], normal[1:, 0] + self.precision * self.expected
        known = np.arange(self.count)
        matrix[known, known] += np.where(self.precision > 0.0, self.precision, _UNDETERMINED_HOLD * np.diag(matrix))
        scales = np.sqrt(np.maximum(np.diag(matrix), np.finfo(np.float64).tiny))
        return np.asarray(np.linalg.solve(matrix / np.outer(scales, scales), right / scales) / scales)

    def step(self, unknown: FloatArray, residual: FloatArray) -> Step:
        moves, weights = [], []
        for row, columns in zip(self.rows, self.columns, strict=True):
            of_scan = unknown[columns[1 + self.modes :] - 1]
            count = len(row.pull.shown.expected)
            weights.append(of_scan[:count])
            pose = of_scan[count:]
            # the similarity about `centre` that unknowns (ω, t, s), or (ω, t) without scale, stand for
            from scipy.spatial.transform import Rotation

            rotation = Rotation.from_rotvec(pose[:3]).as_matrix()
            scale = float(np.exp(pose[6])) if len(pose) > 6 else 1.0
            moves.append(
                Similarity(
                    rotation=rotation, translation=row.centre + pose[3:6] - scale * rotation @ row.centre, scale=scale
                )
            )
        return Step(coefficients=unknown[: self.modes], residual=residual, moves=tuple(moves), weights=tuple(weights))


@dataclass(frozen=True, kw_only=True)
class Membrane:
    """A residual's own stiffness, and how systems of it with pulls on top are solved."""

    stiffness: Any  # (n, n) sparse, the same for each axis
    dissection: Dissection

    @classmethod
    def on_surface(
        cls, surface: DeformableSurface, areas: FloatArray, stiffness: float, spreads: Sequence[Any]
    ) -> Membrane:
        """A membrane on the base, at rest where nothing pulls.

        :param areas: (n,) of the points, mm^2
        :param spreads: of the pulls that there will be
        """
        from scipy.sparse import diags_array

        pairs, weights = cotangent_weights(surface.base, surface.triangles)
        differences = incidence(pairs, len(surface.base))
        resting = np.maximum(surface.held * areas, 1e-4 * max(float(areas.mean()), np.finfo(np.float64).tiny))
        bending = stiffness * (differences.T @ diags_array(weights) @ differences)
        own = bending + diags_array(resting)
        pattern = sum((abs(spread).T @ abs(spread) for spread in spreads), start=abs(own))
        return cls(stiffness=own, dissection=Dissection(pattern, surface.base))

    def factor(self, pulls: Sequence[Pull]) -> FrontalFactor:
        """The factor of the system (3n, 3n) of the residual, axes of a point side by side.

        ``K = kron(stiffness + sum_l a_l s_l s_l^T, 1) + diag(w_i n_i n_i^T)`` of matches with normals n, and of anchors
        that pull by their spreads s.
        """
        from scipy.sparse import diags_array

        shared, blocks = self.stiffness, np.zeros((self.stiffness.shape[0], 3, 3))
        for pull in pulls:
            normals = pull.matches.normals
            blocks[pull.seen] += pull.weights[:, None, None] * normals[:, :, None] * normals[:, None, :]
            shared = shared + pull.spread.T @ diags_array(pull.anchor_weights) @ pull.spread
        return self.dissection.factor(shared, blocks)


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
        self._anchors, self._place, self._start = _moved(view.anchors, view.start), view.start, view.start
        self.spread = view.anchors.matrix(len(surface.base)) @ around
        self._shown = view.shown or Shown.nothing(len(surface.base))
        self._weights = self._shown.expected.copy()

    @property
    def growth(self) -> float:
        """By how much the scan has grown since the start, the logarithm."""
        return float(np.log(self._place.scale / self._start.scale))

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
        if demand.huber > options.huber_mm:
            # Huber's weights for the first steps, where even right anchors lie off. A blunder counts nothing: a few of
            # them would shrink the scan and bend the model to meet it
            farthest = max(_ANCHOR_BLUNDER, 5.0 * float(np.median(off))) if len(off) else 0.0
            trusted = np.asarray(huber_weights(off, 3.0 * demand.huber) * (off <= farthest))
        else:
            trusted = np.asarray(np.maximum(1.0 - (off / max(farthest_anchor(off), 1e-12)) ** 2, 0.0) ** 2)
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
        self._anchors, self._weights = _moved(self._anchors, move), weights
        self._place = Similarity(
            rotation=move.rotation @ self._place.rotation,
            translation=move.apply(self._place.translation[None])[0],
            scale=move.scale * self._place.scale,
        )

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
