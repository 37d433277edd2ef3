"""The actor's other expressions on the topology, from their scans (document S15)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.errors import FitError, InputError
from facepipe.core.names import suggestion
from facepipe.core.threads import one_thread
from facepipe.geometry.closest_points import closest_places, place_shares
from facepipe.geometry.landmarks import mirrored
from facepipe.geometry.polygons import point_normals
from facepipe.geometry.registration import (
    Anchors,
    DeformableSurface,
    Registered,
    RegistrationOptions,
    View,
    register,
    register_together,
)
from facepipe.geometry.similarity import Similarity, robust_similarity
from facepipe.scanning.database import FaceDatabase
from facepipe.scanning.rebuild.declared import FitNeutralOptions, Judged, RegisterScansOptions
from facepipe.scanning.rebuild.fit_neutral import (
    FitNeutralReport,
    NeutralScan,
    found_neutral,
    identity_surface,
    landmark_anchors,
)
from facepipe.scanning.rebuild.scan_fit import ScanFit, scan_fit, scan_target
from facepipe.scanning.rebuild.template import Template, shown_prior
from facepipe.scans import Scan, ScanLandmarks

_FEWEST = 4  # landmarks and markers
_SAME_SIZE = 0.02  # scans nearer in scale than this are of one scale
_REACH_OF_VARIATION = 0.01  # how much the residual's own variance counts per mm^2: about one number each 10 x 10 mm
_FEWEST_OF_NEUTRAL = 6
_RIGID = 1e6  # of the residual's precision: nothing bends
_LANDMARKS_MM = 5.0  # landmarks only begin: the surface places the scan far better than hands do
_ALIKE = 5000.0  # mm^2 over which a person's own motion counts as one number, where noise counts for each mm^2
_SHOWN_SIGMA = 0.05  # of how much of what the neutral's scan shows besides, as it was found alone
_USUAL, _USUAL_NEUTRAL = RegisterScansOptions(), FitNeutralOptions()


@dataclass(frozen=True, kw_only=True)
class ExpressionScan:
    """A scanned expression, and what it shows."""

    scan: Scan
    landmarks: ScanLandmarks
    weights: Mapping[str, float]  # of shapes
    place: Similarity | None = None  # from the scan's coordinates to the face's, where it was registered by itself


@dataclass(frozen=True, kw_only=True)
class Composite:
    """An expression on the topology."""

    points: FloatArray  # (n, 3) whole points, the head where the neutral's is
    weights: Mapping[str, float]  # of shapes, as they were found
    matched: BoolArray  # (n,) points that the scan shows


@dataclass(frozen=True, kw_only=True)
class RegisterScanReport(Judged):
    """How an expression lies on its scan, and the shape that `facepipe register-scan` made of it."""

    fit: ScanFit
    weights: Mapping[str, float]
    beyond_template_mean_mm: float  # from the composite of template shapes, over the face area
    beyond_template_max_mm: float
    name: str = ""  # of the shape

    of_action: ClassVar[tuple[str, ...]] = ("name",)


@one_thread()
def register_scan(
    template: Template,
    neutral: NeutralScan,
    shapes: Mapping[str, FloatArray],
    expression: ExpressionScan,
    options: RegisterScansOptions = _USUAL,
    progress: Callable[[int], None] = lambda step: None,
) -> tuple[Composite, Similarity, RegisterScanReport]:
    """An expression on the topology, the place of its scan, and how it lies there.

    Weights of the composite's shapes, the scan's place, and a smooth residual are solved together. It starts from the
    rebuilt neutral, so that errors of correspondence cancel in deltas. The residual has a Gaussian prior: where the
    expression moves much, people differ much; what it does not move keeps the head in its place (the document's
    calibration points at ears and back of the head). Each scan has its own matches, and so its own factor.

    :param shapes: name -> (n, 3) whole deltas of the personal template
    :raises InputError: a shape that is not there, too few landmarks and markers, or a scan that can't be used
    :raises FitError: a scan that does not show this face
    """
    name = expression.scan.name
    missing = [shape for shape in expression.weights if shape not in shapes]
    if missing:
        what = f"no such shape in the personal template{suggestion(missing[0], shapes)}"
        raise InputError(f"{name} -> {missing[0]}", what)
    surface = expression_surface(template, neutral, shapes, expression.weights, options)
    anchors = expression_anchors(template, neutral, expression)
    if len(anchors) < _FEWEST:
        raise InputError(f"{name} -> landmarks", f"{len(anchors)} and markers, expected {_FEWEST} or more")
    given = surface.points(surface.expected)
    places = anchors.places(given)
    if mirrored(anchors.targets, places):
        raise InputError(f"{name} -> landmarks", "fit a mirrored face, expected left and right as the person has them")
    start, hold = robust_similarity(anchors.targets, places), False
    if neutral.place is not None and abs(start.scale / neutral.place.scale - 1.0) <= _SAME_SIZE:
        held = robust_similarity(anchors.targets * neutral.place.scale, places, scale=False)
        start, hold = replace(held, scale=neutral.place.scale), True
    target, mended = scan_target(expression.scan)
    try:
        registered = register(surface, target, anchors, start, options.registration(scale=not hold), progress)
    except FitError as error:
        raise error.under(name) from None
    weights = dict(zip(expression.weights, map(float, registered.coefficients), strict=True))
    deltas = np.tensordot(registered.coefficients, np.stack([shapes[shape] for shape in weights]), axes=1)
    points = template.whole(neutral.points + deltas, registered.points)
    off = np.linalg.norm(registered.points - given, axis=1)[template.face]
    lines = [*expression.scan.warnings, *mended]
    if neutral.place is not None and not hold:
        times = f"{start.scale / neutral.place.scale:.4g} times"
        lines.append(f"{name}: 1 unit is {times} that of the neutral's scan, fitted freely")
    report = RegisterScanReport(
        fit=scan_fit(name, registered, template.face, anchors.names),
        weights=weights,
        beyond_template_mean_mm=float(off.mean()) if len(off) else 0.0,
        beyond_template_max_mm=float(off.max(initial=0.0)),
        warnings=tuple(lines),
    )
    # Loose parts stay unmatched: they follow the skin, so where they are is no evidence of the scan.
    matched = np.where(template.row_of >= 0, registered.matched[template.row_of], False)
    return Composite(points=points, weights=weights, matched=matched), registered.place, report


def expression_surface(
    template: Template,
    neutral: NeutralScan,
    shapes: Mapping[str, FloatArray],
    weights: Mapping[str, float],
    options: RegisterScansOptions,
) -> DeformableSurface:
    """The neutral's skin by the shapes of an expression, with room for the person's own motion."""
    modes = np.stack([shapes[shape][template.rows] for shape in weights])
    expected = np.array([float(weight) for weight in weights.values()])
    # The residual's standard deviation is still + variation * motion: where much moves, people differ much.
    spread = expected_spread(modes, expected, options)
    return DeformableSurface(
        base=neutral.points[template.rows],
        modes=modes,
        expected=expected,
        precision=np.full(len(expected), 1.0 / options.weight_sigma**2),
        triangles=template.triangles,
        seen=template.seen,
        held=_REACH_OF_VARIATION / spread**2,
        labels=template.labels,
    )


def expected_spread(modes: FloatArray, weights: FloatArray, options: RegisterScansOptions) -> FloatArray:
    """(m,) millimetres that a person's expression may be from the template's, by its shapes' deltas (k, m, 3)."""
    motion = np.tensordot(weights, np.linalg.norm(modes, axis=2), axes=1)
    return np.asarray(options.still_mm + options.variation * motion)


def expression_anchors(template: Template, neutral: NeutralScan, expression: ExpressionScan) -> Anchors:
    """Landmarks, and the painted markers that the neutral's scan has too."""
    anchors = landmark_anchors(template, expression.landmarks)
    painted = expression.landmarks.markers
    common = [marker for marker in painted if marker in neutral.landmarks.markers]
    if neutral.place is None or not common:
        return anchors
    places = neutral.place.apply(np.array([neutral.landmarks.markers[marker] for marker in common]))
    skin = neutral.shown[template.rows]
    nearest = closest_places(places, skin, template.triangles)
    markers = Anchors(
        corners=template.triangles[nearest.triangles],
        shares=place_shares(nearest, skin, template.triangles),
        targets=np.array([painted[marker] for marker in common], np.float64),
        names=tuple(f"marker {marker}" for marker in common),
    )
    return anchors.with_more(markers)


def placed_neutral(
    template: Template,
    points: FloatArray,
    scan: Scan,
    landmarks: ScanLandmarks,
    expression: FloatArray | None = None,
) -> NeutralScan:
    """A neutral with the place and size of its scan, see `neutral_place`.

    :param expression: (n, 3) whole delta that the scan shows besides, such as closed eyes
    """
    neutral = NeutralScan(points=points, landmarks=landmarks, expression=expression)
    return replace(neutral, place=neutral_place(template, neutral.shown, scan, landmarks))


def neutral_place(
    template: Template, points: FloatArray, scan: Scan, landmarks: ScanLandmarks, seen: IntArray | None = None
) -> Similarity:
    """From a scan to its neutral, found by landmarks, then by the surface; the neutral stays.

    :param points: (n, 3) whole points, as the scan shows them
    :param seen: rows of the skin to place it by, ascending; None: all that a scan can show
    :raises InputError: too few landmarks, or a scan that can't be used
    :raises FitError: a scan that does not show this face
    """
    known = landmarks.known
    if known.sum() < _FEWEST_OF_NEUTRAL:
        what = f"{int(known.sum())} of 68 are known, expected {_FEWEST_OF_NEUTRAL} or more"
        raise InputError(f"{scan.name} -> landmarks", what)
    # Nothing bends: only the place is sought.
    surface = neutral_surface(template, points, held=_RIGID)
    surface = surface if seen is None else replace(surface, seen=seen)
    start = robust_similarity(landmarks.points[known], surface.base[template.landmarks][known])
    anchors = Anchors.at_points(template.landmarks, landmarks.points)
    options = RegistrationOptions(anchor_sigma_mm=_LANDMARKS_MM)
    target, _ = scan_target(scan)
    try:
        return register(surface, target, anchors, start, options).place
    except FitError as error:
        raise error.under(scan.name) from None


def neutral_surface(template: Template, points: FloatArray, held: float = 0.0) -> DeformableSurface:
    """The skin of a known neutral, with no modes.

    :param points: (n, 3) whole points
    :param held: how much a residual is drawn to 0, per mm^2
    """
    count = len(template.rows)
    return DeformableSurface(
        base=points[template.rows],
        modes=np.zeros((0, count, 3)),
        expected=np.zeros(0),
        precision=np.zeros(0),
        triangles=template.triangles,
        seen=template.seen,
        held=np.full(count, held),
        labels=template.labels,
    )


@one_thread()
def fit_together(
    template: Template,
    scan: Scan,
    first: NeutralScan,
    coefficients: FloatArray,
    database: FaceDatabase,
    shapes: Mapping[str, FloatArray],
    placed: Sequence[ExpressionScan],
    options: FitNeutralOptions = _USUAL_NEUTRAL,
    expression_options: RegisterScansOptions = _USUAL,
) -> tuple[NeutralScan, FitNeutralReport, tuple[Registered, ...], float]:
    """The neutral, how it lies on its scan, what was found on each other, and how far its face has moved (mm, mean).

    Identity coefficients and residual of one face, the weights of each expression's shapes, and each scan's place are
    solved in one system. An expression shows where its points would be at rest with the variance of the noise, and of
    the person's own motion beyond the template's. So landmarks where it hardly moves count like the neutral's own, and
    its surface where the neutral's scan shows none.

    :param first: the neutral as fitted to `scan` alone with `coefficients` (k,), and its place and landmarks
    :param shapes: name -> (n, 3) whole deltas of its personal template
    :param placed: expressions that were registered by themselves, with their places
    :raises InputError: no expression, a neutral without a place, or a scan that can't be used
    :raises FitError: a scan that does not show this face
    """
    if not placed or first.place is None:
        raise InputError(scan.name, "no expressions or no place of it, expected both to fit together")
    surface = identity_surface(template, database.identity, options)
    residual = first.points[template.rows] - surface.points(coefficients)
    (target, mended), solver = scan_target(scan), options.registration
    anchors = landmark_anchors(template, first.landmarks)
    besides = {} if first.expression is None else {"shown": first.expression}  # as one shape
    prior = shown_prior(template, besides, dict.fromkeys(besides, 1.0), _SHOWN_SIGMA)
    views = [View(scan=target, anchors=anchors, start=first.place, shown=prior, name=f"{scan.name} -> scan")]
    for one in placed:  # with how far its points may be from where they would be at rest
        weights = shown_prior(template, shapes, one.weights, expression_options.weight_sigma)
        assert one.place is not None
        assert weights is not None
        spread = expected_spread(weights.modes, weights.expected, expression_options)
        marks = expression_anchors(template, first, one)
        # Variances add: of the landmarks' noise, and of the person's own motion beyond the template's.
        held = np.sqrt(marks.variances(options.landmark_sigma_mm) + marks.places(spread) ** 2)
        view = View(
            scan=scan_target(one.scan)[0],
            anchors=replace(marks, sigmas=held),
            start=one.place,
            shown=weights,
            sigmas=np.sqrt(solver.surface_sigma_mm**2 + _ALIKE * spread**2),
            name=f"{one.scan.name} -> scan",
        )
        views.append(view)
    points = first.shown[template.rows]
    normals = point_normals(points, template.triangles)
    shows = target.matches(points, normals, solver.reach_mm, solver.angle, first.place).kept
    found = register_together(surface, _balanced(views, shows, options), coefficients, residual, solver)
    lines = (*scan.warnings, *mended)
    neutral, report = found_neutral(template, database.identity, scan.name, found[0], anchors.names, lines, besides)
    moved = np.linalg.norm((neutral.points - first.points)[template.rows[template.face]], axis=1)
    return replace(neutral, landmarks=first.landmarks), report, found[1:], float(moved.mean()) if len(moved) else 0.0


def _balanced(views: Sequence[View], shows: BoolArray, options: FitNeutralOptions) -> list[View]:
    """The views, each point of which counts together as much as on one scan, shared by what they know of it.

    What surfaces show is wrong in the same way on every scan: where points lie along them. Landmarks err one by
    one; a landmark of n scans counts as much as sqrt(n), since the model's prior was made for one scan.

    :param shows: (m,) points that the first scan shows
    """
    surfaces, landmarks = options.registration.surface_sigma_mm, options.landmark_sigma_mm
    sigmas = [np.full(len(shows), surfaces) if view.sigmas is None else view.sigmas for view in views]
    known = shows / sigmas[0] ** 2 + sum(1.0 / sigma**2 for sigma in sigmas[1:])
    # sum 1 / (sigma_v share)^2 = 1 / surface_sigma^2 over the views: as on one scan.
    share = surfaces * np.sqrt(known)
    counts: dict[str, float] = {}
    for view in views:
        for name, variance in zip(view.anchors.names, view.anchors.variances(landmarks), strict=True):
            counts[name] = counts.get(name, 0.0) + landmarks**2 / variance
    balanced = []
    for view, sigma in zip(views, sigmas, strict=True):
        often = np.array([max(1.0, counts[name]) for name in view.anchors.names])
        # Sigma by n^(1/4) is precision by 1 / sqrt(n): n scans come to sqrt(n).
        held = np.sqrt(view.anchors.variances(landmarks)) * often**0.25
        balanced.append(replace(view, sigmas=sigma * share, anchors=replace(view.anchors, sigmas=held)))
    return balanced
