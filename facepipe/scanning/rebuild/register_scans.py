"""The actor's other expressions on the topology, from their scans (document S15)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.errors import FitError, InputError
from facepipe.core.names import suggestion
from facepipe.core.reports import Report
from facepipe.core.threads import one_thread
from facepipe.geometry.closest_points import closest_places, place_shares
from facepipe.geometry.landmarks import mirrored
from facepipe.geometry.polygons import point_normals
from facepipe.geometry.registration import (
    Anchors,
    DeformableSurface,
    RegistrationOptions,
    ScanTarget,
    Shown,
    View,
    register,
    register_together,
)
from facepipe.geometry.similarity import Similarity, robust_similarity
from facepipe.scanning.database import FaceDatabase
from facepipe.scanning.rebuild.fit_neutral import NeutralFit, identity_surface, landmark_anchors, neutral_fit
from facepipe.scanning.rebuild.options import FitNeutralOptions, RegisterScansOptions
from facepipe.scanning.rebuild.scan_fit import ScanFit, scan_fit, scan_target
from facepipe.scanning.rebuild.template import ShownShapes, Template
from facepipe.scans import Scan, ScanLandmarks

_FEWEST = 4  # landmarks and markers
_SAME_SIZE = 0.02  # scans nearer in scale than this are of one scale
_REACH_OF_VARIATION = 0.01  # how much the residual's own variance counts per mm^2: about one number each 10 x 10 mm
_FEWEST_OF_NEUTRAL = 6
_RIGID = 1e6  # of the residual's precision: nothing bends
_LANDMARKS_MM = 5.0  # landmarks only begin: the surface places the scan far better than hands do
_ALIKE = 5000.0  # mm^2 over which a person's own motion counts as one number, where noise counts for each mm^2
_SHOWN_SIGMA = 0.05  # of how much of what the neutral's scan shows besides, as it was found alone


@dataclass(frozen=True, kw_only=True)
class ExpressionScan:
    """A scanned expression, and what it shows."""

    scan: Scan
    landmarks: ScanLandmarks
    weights: Mapping[str, float]  # of shapes


@dataclass(frozen=True, kw_only=True)
class Composite:
    """An expression on the topology."""

    points: FloatArray  # (n, 3) whole points, the head where the neutral's is
    weights: Mapping[str, float]  # of shapes, as they were found
    matched: BoolArray  # (n,) points that the scan shows


@dataclass(frozen=True, kw_only=True)
class RegisteredComposite(Composite):
    """An expression, and how it lies on its scan."""

    place: Similarity  # from the scan's coordinates
    report: CompositeReport


@dataclass(frozen=True, kw_only=True)
class CompositeReport(Report):
    """How an expression lies on its scan."""

    fit: ScanFit
    weights: Mapping[str, float]
    beyond_template_mean_mm: float  # from the composite of template shapes, over the face area
    beyond_template_max_mm: float


@dataclass(frozen=True, kw_only=True)
class NeutralScan:
    """The neutral that expressions are registered from."""

    points: FloatArray  # (n, 3) whole points
    # From its scan's coordinates; None where there is none: sizes of scans are fitted, and markers are ignored.
    place: Similarity | None = None
    landmarks: ScanLandmarks = field(default_factory=ScanLandmarks)  # markers on it are followed
    expression: FloatArray | None = None  # (n, 3) whole delta that its scan shows besides; None: none

    @property
    def shown(self) -> FloatArray:
        """(n, 3) whole points as its scan shows them."""
        return self.points if self.expression is None else self.points + self.expression


@dataclass(frozen=True, kw_only=True)
class RegisterScans:
    """Weights of the composite's shapes, the scan's place, and a smooth residual, solved together.

    It starts from the rebuilt neutral, so that errors of correspondence cancel in deltas. The residual has a Gaussian
    prior: where the expression moves much, people differ much; what it does not move keeps the head in its place (the
    document's calibration points at ears and back of the head). Each scan has its own matches, and so its own factor.
    """

    options: RegisterScansOptions = field(default_factory=RegisterScansOptions)

    @one_thread()
    def __call__(
        self,
        template: Template,
        neutral: NeutralScan,
        shapes: Mapping[str, FloatArray],
        expression: ExpressionScan,
        progress: Callable[[int], None] = lambda step: None,
    ) -> RegisteredComposite:
        """Register one expression.

        :param shapes: name -> (n, 3) whole deltas of the personal template
        :raises InputError: a shape that is not there, too few landmarks and markers, or a scan that can't be used
        :raises FitError: a scan that does not show this face
        """
        name = expression.scan.name
        missing = [shape for shape in expression.weights if shape not in shapes]
        if missing:
            near = suggestion(missing[0], shapes)
            raise InputError(f"{name} -> {missing[0]}", f"no such shape in the personal template{near}")
        surface = self._surface(template, neutral, shapes, expression.weights)
        anchors = expression_anchors(template, neutral, expression)
        if len(anchors) < _FEWEST:
            raise InputError(f"{name} -> landmarks", f"{len(anchors)} and markers, expected {_FEWEST} or more")
        if mirrored(anchors.targets, anchors.places(surface.points(surface.expected))):
            what = "fit a mirrored face, expected left and right as the person has them"
            raise InputError(f"{name} -> landmarks", what)
        start, hold = _start(surface, anchors, neutral)
        target, mended = scan_target(expression.scan)
        options = RegistrationOptions(
            membrane=self.options.membrane,
            anchor_sigma_mm=self.options.landmark_sigma_mm,
            reach_mm=self.options.reach_mm,
            scale=not hold,
        )
        try:
            registered = register(surface, target, anchors, start, options, progress)
        except FitError as error:
            raise error.under(name) from None
        weights = dict(zip(expression.weights, map(float, registered.coefficients), strict=True))
        deltas = np.tensordot(registered.coefficients, np.stack([shapes[shape] for shape in weights]), axes=1)
        points = template.whole(neutral.points + deltas, registered.points)
        given = surface.points(surface.expected)
        off = np.linalg.norm(registered.points - given, axis=1)[template.face]
        report = CompositeReport(
            fit=scan_fit(name, registered, template.face, anchors.names),
            weights=weights,
            beyond_template_mean_mm=float(off.mean()) if len(off) else 0.0,
            beyond_template_max_mm=float(off.max(initial=0.0)),
            warnings=(*expression.scan.warnings, *mended, *_resized(name, start.scale, neutral, hold)),
        )
        # Loose parts stay unmatched: they follow the skin, so where they are is no evidence of the scan.
        matched = np.zeros(len(points), bool)
        skin = template.row_of >= 0
        matched[skin] = registered.matched[template.row_of[skin]]
        return RegisteredComposite(
            points=points, weights=weights, matched=matched, place=registered.place, report=report
        )

    def _surface(
        self,
        template: Template,
        neutral: NeutralScan,
        shapes: Mapping[str, FloatArray],
        weights: Mapping[str, float],
    ) -> DeformableSurface:
        modes = np.stack([shapes[shape][template.rows] for shape in weights])
        expected = np.array([float(weight) for weight in weights.values()])
        spread = expected_spread(modes, expected, self.options)
        return DeformableSurface(
            base=neutral.points[template.rows],
            modes=modes,
            expected=expected,
            precision=np.full(len(expected), 1.0 / self.options.weight_sigma**2),
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


def _start(surface: DeformableSurface, anchors: Anchors, neutral: NeutralScan) -> tuple[Similarity, bool]:
    """About where the scan lies, and whether it has the scale of the neutral's scan."""
    places = anchors.places(surface.points(surface.expected))
    free = robust_similarity(anchors.targets, places)
    if neutral.place is None:
        return free, False
    size = neutral.place.scale
    if abs(free.scale / size - 1.0) > _SAME_SIZE:
        return free, False
    held = robust_similarity(anchors.targets * size, places, scale=False)
    return Similarity(rotation=held.rotation, translation=held.translation, scale=size), True


def _resized(name: str, scale: float, neutral: NeutralScan, hold: bool) -> tuple[str, ...]:
    if hold or neutral.place is None:
        return ()
    return (f"{name}: 1 unit is {scale / neutral.place.scale:.4g} times that of the neutral's scan, fitted freely",)


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


@dataclass(frozen=True, kw_only=True)
class PlacedExpression:
    """A scanned expression that was registered by itself."""

    expression: ExpressionScan
    place: Similarity  # from the scan's coordinates to the face's


@dataclass(frozen=True, kw_only=True)
class TogetherFit:
    """The neutral, and what the scans show of it."""

    neutral: NeutralFit
    weights: tuple[Mapping[str, float], ...]  # of each expression's shapes
    places: tuple[Similarity, ...]  # of each expression's scan
    moved_mean_mm: float  # of the neutral, over the face area


@dataclass(frozen=True, kw_only=True)
class FitTogether:
    """Identity coefficients and residual of one face, the weights of each scanned expression's shapes, and the place of
    each scan, solved in one system.

    Each expression shows where its points would be at rest, as surely as people do alike: with the variance of the
    noise, and of the person's own motion beyond the template's. So landmarks where it hardly moves count like the
    neutral's own, and its surface where the neutral's scan shows none.
    """

    neutral: FitNeutralOptions = field(default_factory=FitNeutralOptions)
    expressions: RegisterScansOptions = field(default_factory=RegisterScansOptions)

    @one_thread()
    def __call__(
        self,
        template: Template,
        scan: Scan,
        first: NeutralScan,
        coefficients: FloatArray,
        database: FaceDatabase,
        shapes: Mapping[str, FloatArray],
        placed: Sequence[PlacedExpression],
        progress: Callable[[int], None] = lambda step: None,
    ) -> TogetherFit:
        """Refine the neutral.

        :param scan: the neutral's
        :param first: the neutral as fitted alone, with its place and landmarks
        :param coefficients: (k,) of the identity model that it was fitted with, in standard deviations
        :param shapes: name -> (n, 3) whole deltas of its personal template
        :raises InputError: no expression, a neutral without a place, or a scan that can't be used
        :raises FitError: a scan that does not show this face
        """
        if not placed or first.place is None:
            raise InputError(scan.name, "no expressions or no place of it, expected both to fit together")
        surface = identity_surface(template, database.identity, self.neutral)
        residual = first.points[template.rows] - surface.points(coefficients)
        target, mended = scan_target(scan)
        anchors, besides = landmark_anchors(template, first.landmarks), _besides(first)
        neutral_view = View(
            scan=target,
            anchors=anchors,
            start=first.place,
            shown=besides.prior(template, _SHOWN_SIGMA),
            name=f"{scan.name} -> scan",
        )
        views = [neutral_view, *(self._view(template, first, shapes, one) for one in placed)]
        views = self._balanced(views, self._shows(template, target, first, first.place))
        options = self.neutral.registration
        registered = register_together(surface, views, coefficients, residual, options, progress)
        lines = (*scan.warnings, *mended)
        neutral = neutral_fit(template, database.identity, scan.name, registered[0], anchors.names, lines, besides)
        return TogetherFit(
            neutral=neutral,
            weights=tuple(
                dict(zip(one.expression.weights, map(float, each.weights), strict=True))
                for one, each in zip(placed, registered[1:], strict=True)
            ),
            places=tuple(each.place for each in registered[1:]),
            moved_mean_mm=_moved(template, first.points, neutral.points),
        )

    def _view(
        self, template: Template, first: NeutralScan, shapes: Mapping[str, FloatArray], placed: PlacedExpression
    ) -> View:
        """An expression's scan, with how far its points may be from where they would be at rest."""
        expression = placed.expression
        modes = np.stack([shapes[shape][template.rows] for shape in expression.weights])
        expected = np.array([float(weight) for weight in expression.weights.values()])
        spread = expected_spread(modes, expected, self.expressions)
        anchors = expression_anchors(template, first, expression)
        held = np.sqrt(anchors.variances(self.neutral.landmark_sigma_mm) + anchors.places(spread) ** 2)
        precision = np.full(len(expected), 1.0 / self.expressions.weight_sigma**2)
        return View(
            scan=scan_target(expression.scan)[0],
            anchors=replace(anchors, sigmas=held),
            start=placed.place,
            shown=Shown(modes=modes, expected=expected, precision=precision),
            sigmas=np.sqrt(self.neutral.registration.surface_sigma_mm**2 + _ALIKE * spread**2),
            name=f"{expression.scan.name} -> scan",
        )

    def _shows(self, template: Template, target: ScanTarget, first: NeutralScan, place: Similarity) -> BoolArray:
        """(m,) rows of the skin that have a place on the neutral's scan."""
        points = (first.points + (0.0 if first.expression is None else first.expression))[template.rows]
        normals, options = point_normals(points, template.triangles), self.neutral.registration
        return target.matches(points, normals, options.reach_mm, options.angle, place).kept

    def _balanced(self, views: Sequence[View], shows: BoolArray) -> list[View]:
        """The views, each point of which counts together as much as on one scan, shared by what they know of it.

        What surfaces show is wrong in the same way on every scan: where points lie along them. Landmarks err one by
        one; a landmark of n scans counts as much as sqrt(n), since the model's prior was made for one scan.

        :param shows: (m,) points that the first scan shows
        """
        surfaces, landmarks = self.neutral.registration.surface_sigma_mm, self.neutral.landmark_sigma_mm
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


def _besides(first: NeutralScan) -> ShownShapes:
    """What the neutral's scan shows besides, as one shape."""
    if first.expression is None:
        return ShownShapes()
    return ShownShapes(deltas={"shown": first.expression}, weights={"shown": 1.0})


def _moved(template: Template, before: FloatArray, after: FloatArray) -> float:
    face = template.rows[template.face]
    return float(np.linalg.norm(after[face] - before[face], axis=1).mean()) if len(face) else 0.0
