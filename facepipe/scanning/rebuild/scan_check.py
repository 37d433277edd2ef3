"""Whether a scanned expression can be the actor's, showing what it is named for."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.names import first_names
from facepipe.geometry.bounded_least_squares import BoxedQuadratic
from facepipe.geometry.polygons import point_areas
from facepipe.scanning.rebuild.project import Project
from facepipe.scanning.rebuild.register_scans import Composite
from facepipe.scanning.rebuild.template import Template

# How a person's own motion differs from the template's, as a share of it: simulated people 0.18, more is rare.
_OWN_WAY = 0.25
# Asked weights may be found smaller or larger by these factors: about three times how much people's motion differs.
_LEAST, _MOST = 0.5, 1.75
_ANY = 1.5  # largest weight of a shape that a scan may show instead
_SLIGHT_MM = 0.2  # RMS over the face that is not worth a shape at weight 1
_STILL_MM = 0.05  # the same of no motion
_PLACED_MM, _HALF_HEAD_MM = 20.0, 100.0  # how far a scan may be misplaced, and the points that turns move by that
_POINTS = 4000  # of the face area, evenly taken: enough for a median
_NAMED, _WORTH_NAMING = 3, 0.2  # shapes that a scan shows instead: how many a line names, and from which weight

# A scan is left out beyond the first number, and beyond the second where it stands out among the actor's others. On
# simulated people right scans are 0.0 mm off and leave up to 0.04 of their motion, scans of other people are 2 to 3 mm
# off, and other expressions leave 0.35 and more. Landmarks that are found on right scans may be 2 to 3 mm off.
_LIMITS = {"off_mm": (1.0, 0.5), "unexplained": (0.5, 0.25), "landmark_mm": (6.0, 3.0)}
# Of the actor, half of the face is nearer than that to some mixture of no more shapes than that, all weights summed:
# simulated 0.0 to 0.2 mm and 4, other people 0.3 to 0.7 mm and 9 or more.
_SAME_PERSON_MM, _SHAPES = 0.3, 8.0
_LEAST_COVERAGE = 0.25  # less of the face does not hold a scan in its place
_SPREADS = 6.0  # robust standard deviations from the median of the others: what stands out
_FEWEST = 2  # other scans that show what is usual


Guess = Literal["place", "expression", "person"]  # of the actor in another place or size, or showing another expression


@dataclass(frozen=True, kw_only=True)
class ScanCheck:
    """How a registered expression differs from what its shapes make of the neutral."""

    off_mm: float  # half of the face is off by more, beyond what people's own way of moving explains
    unexplained: float  # share of its motion (squared) that its shapes leave, at about the weights asked for
    coverage: float  # share 0..1 of the face area that has a match
    landmark_mm: float  # mean distance
    nearest: Mapping[str, float]  # the mixture of all shapes that comes nearest: the largest weights
    guess: Guess  # of a scan that does not belong: what it may be of


def scan_checks(
    template: Template,
    neutral: FloatArray,
    shapes: Mapping[str, FloatArray],
    composites: Mapping[str, Composite],
    fits: Mapping[str, Mapping[str, Any]],
) -> dict[str, ScanCheck]:
    """Scan -> its check against a neutral and its shapes.

    :param neutral: (n, 3) whole points
    :param shapes: name -> (n, 3) whole deltas of the personal template
    :param composites: scan -> what was registered, with the weights asked for
    :param fits: scan -> `ScanFit` as JSON
    """
    face, names = np.flatnonzero(template.face), tuple(shapes)
    some = face[:: max(1, len(face) // _POINTS)]
    points, areas = template.rows[some], point_areas(neutral[template.rows], template.triangles)[some]
    deltas, checks = np.stack([delta[points] for delta in shapes.values()]), {}  # (e, s, 3)
    for scan, composite in composites.items():
        seen = composite.matched[points]
        rows = points[seen]
        fitted = _Mixtures(deltas[:, seen], neutral[rows], areas[seen], composite.points[rows] - neutral[rows])
        asked = np.array([max(composite.weights.get(name, 0.0), 0.0) for name in names])
        own, placed = (fitted.weights(asked, _LEAST * asked, _MOST * asked, placed=one) for one in (False, True))
        nothing = np.zeros_like(asked)
        nearest = fitted.weights(nothing, nothing, np.maximum(_ANY, _MOST * asked), placed=True)
        largest = sorted(zip(-nearest[: len(asked)], names, strict=True))[:_NAMED]
        guess: Guess = "person"
        if fitted.off_mm(placed) <= _LIMITS["off_mm"][1] and fitted.unexplained(placed) <= _LIMITS["unexplained"][1]:
            guess = "place"
        elif fitted.off_mm(nearest) <= _SAME_PERSON_MM and nearest[: len(asked)].sum() <= _SHAPES:
            guess = "expression"
        checks[scan] = ScanCheck(
            off_mm=fitted.off_mm(own),
            unexplained=fitted.unexplained(own),
            coverage=fits[scan]["coverage"],
            landmark_mm=fits[scan]["landmark_mean_mm"],
            nearest={name: float(-less) for less, name in largest if -less >= _WORTH_NAMING},
            guess=guess,
        )
    return checks


class _Mixtures:
    """Sums of shapes against a motion.

    :param deltas: (e, p, 3) of shapes
    :param points: (p, 3) of the neutral
    :param areas: (p,)
    :param motion: (p, 3)
    """

    def __init__(self, deltas: FloatArray, points: FloatArray, areas: FloatArray, motion: FloatArray) -> None:
        self._lengths, self._motion = np.linalg.norm(deltas, axis=2), motion
        # (7, p, 3) what shifts, turns and a change of size move points by: `_PLACED_MM` at about a head's half
        axes = np.eye(3)
        shifts = np.broadcast_to(axes[:, None], (3, len(points), 3))
        around = (points - points.mean(axis=0)) / _HALF_HEAD_MM if len(points) else points
        turns = np.stack([np.cross(axis, around) for axis in axes])
        self._deltas = np.concatenate([deltas, (_PLACED_MM * np.concatenate([shifts, turns, around[None]]))])
        self._shares = areas / max(float(areas.sum()), np.finfo(float).tiny)
        weighted = self._deltas * self._shares[:, None]
        self._pulls = np.tensordot(weighted, motion, axes=((1, 2), (0, 1)))
        self._products = np.tensordot(weighted, self._deltas, axes=((1, 2), (1, 2)))
        self._products += _SLIGHT_MM**2 * np.eye(len(self._deltas))

    def weights(self, start: FloatArray, low: FloatArray, high: FloatArray, *, placed: bool = False) -> FloatArray:
        """(e + 7,) of the nearest sum within bounds, drawn faintly to `start`, which lies between them.

        :param placed: in whatever place and size comes nearest
        """
        room = np.full(7, 1.0 if placed else 0.0)
        start, low, high = (np.append(one, more) for one, more in ((start, 0.0 * room), (low, -room), (high, room)))
        slope = self._products @ start - _SLIGHT_MM**2 * start - self._pulls
        return start + BoxedQuadratic(self._products).minimise(slope, low - start, high - start)

    def off_mm(self, weights: FloatArray) -> float:
        """Median over the area of what a sum leaves, less what people move in their own way."""
        own_way = _OWN_WAY * np.tensordot(weights[:-7], self._lengths, axes=1)
        beyond = np.maximum(np.linalg.norm(self._left(weights), axis=1) - own_way, 0.0)
        order = np.argsort(beyond, kind="stable")
        middle = int(np.searchsorted(np.cumsum(self._shares[order]), 0.5))
        return float(beyond[order[min(middle, len(order) - 1)]]) if len(order) else 0.0

    def unexplained(self, weights: FloatArray) -> float:
        """Squared motion that a sum leaves, over all of it."""
        left, moved = (
            float((self._shares * (one**2).sum(axis=1)).sum()) for one in (self._left(weights), self._motion)
        )
        return left / max(moved, _STILL_MM**2)

    def _left(self, weights: FloatArray) -> FloatArray:
        return np.asarray(self._motion - np.tensordot(weights, self._deltas, axes=1))


def misfits(checks: Mapping[str, ScanCheck], asked: Mapping[str, Mapping[str, float]]) -> dict[str, str]:
    """Scan -> why it does not belong, by the first limit that it misses, of those that don't.

    :param asked: scan -> the shapes that it is to show
    """
    reasons = {}
    for scan, check in checks.items():
        others = [other for key, other in checks.items() if key != scan]
        limits = {}
        for name, (surely, standing_out) in _LIMITS.items():  # less where the actor's other scans are much alike
            limits[name] = surely
            if len(others) >= _FEWEST:
                values = np.array([getattr(other, name) for other in others])
                middle = np.median(values)
                spread = 1.4826 * np.median(np.abs(values - middle))  # of a normal distribution: its standard deviation
                limits[name] = float(np.clip(middle + _SPREADS * spread, standing_out, surely))
        if check.coverage < _LEAST_COVERAGE:
            least = f"expected {100 * _LEAST_COVERAGE:.0f} % or more"
            reasons[scan] = f"it shows {100 * check.coverage:.0f} % of the face, {least}"
        elif check.off_mm > limits["off_mm"] or check.unexplained > limits["unexplained"]:
            instead = ", ".join(f"{name} {weight:.2f}" for name, weight in check.nearest.items())
            guess = {
                "expression": f"it shows {instead or 'no shape clearly'}",
                "place": "it may be of another size, or misplaced",
                "person": "it may be another person's",
            }[check.guess]
            reasons[scan] = (
                f"{guess}; half of the face is {check.off_mm:.1f} mm or more from the neutral with "
                f"{first_names(tuple(asked[scan]), 3)} (expected {limits['off_mm']:.1f} mm at most), which leaves "
                f"{100 * min(check.unexplained, 1.0):.0f} % of the motion (expected "
                f"{100 * limits['unexplained']:.0f} % at most)"
            )
        elif check.landmark_mm > limits["landmark_mm"]:
            most = f"expected {limits['landmark_mm']:.1f} mm at most"
            reasons[scan] = f"landmarks are {check.landmark_mm:.1f} mm off, {most}"
    return reasons


def left_out_lines(project: Project, reasons: Mapping[str, str]) -> Iterator[str]:
    """A line for each scan that does not belong, and one where so many speak against the neutral's."""
    scans = {scan.name: scan.scan.name for scan in project.expressions}
    for name in filter(reasons.__contains__, scans):
        yield f"{name}: {scans[name]} does not belong and is left out: {reasons[name]}"
    if len(reasons) > max(1, len(scans) / 2):
        file = project.neutral.scan.name
        yield f"{len(reasons)} of {len(scans)} expressions are left out: {file} may be another person's"
