"""The neutral refined on all scans together: identity, expression weights, each scan's place (document S15)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray
from facepipe.core.errors import InputError
from facepipe.core.threads import one_thread
from facepipe.geometry.polygons import point_normals
from facepipe.geometry.registration import ScanTarget, Shown, View, register_together
from facepipe.geometry.similarity import Similarity
from facepipe.scanning.database import FaceDatabase
from facepipe.scanning.rebuild.composites import ShownShapes
from facepipe.scanning.rebuild.fit_neutral import NeutralFit, identity_surface, landmark_anchors, neutral_fit
from facepipe.scanning.rebuild.options import FitNeutralOptions, RegisterScansOptions
from facepipe.scanning.rebuild.register_scans import ExpressionScan, NeutralScan, expected_spread, expression_anchors
from facepipe.scanning.rebuild.scan_fit import scan_target
from facepipe.scanning.rebuild.template import Template
from facepipe.scans import Scan

_ALIKE = 5000.0  # mm^2 over which a person's own motion counts as one number, where noise counts for each mm^2
_SHOWN_SIGMA = 0.05  # of how much of what the neutral's scan shows besides, as it was found alone


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
