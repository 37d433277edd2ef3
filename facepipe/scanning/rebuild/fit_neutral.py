"""The actor's neutral from its scan, an identity model and a smooth residual (document S13)."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import FitError, InputError, TopologyError
from facepipe.core.names import first_names
from facepipe.core.reports import Report
from facepipe.core.threads import one_thread
from facepipe.geometry.geodesics import graph_distances
from facepipe.geometry.identity_model import IdentityModel
from facepipe.geometry.landmarks import mirrored
from facepipe.geometry.polygons import flipped_triangles
from facepipe.geometry.registration import Anchors, DeformableSurface, Registered, register
from facepipe.geometry.similarity import Similarity, robust_similarity
from facepipe.scanning.database import FaceDatabase, Quality
from facepipe.scanning.rebuild.options import UNITS, FitNeutralOptions
from facepipe.scanning.rebuild.scan_fit import ScanFit, scan_fit, scan_target, unit_of
from facepipe.scanning.rebuild.template import ShownShapes, Template
from facepipe.scans import Scan, ScanLandmarks
from facepipe.verbs.skin.surface import points_between, smoothstep, surface_of

_SHUT = 0.21  # of an eye's width, that lids' landmarks are apart; those found on a real scan's shut eyes are 0.2
_SEALED = 0.03  # of the mouth's width, that lips' landmarks are apart
_UPPER, _LOWER = (60, 61, 62, 63, 64), (60, 67, 66, 65, 64)  # the lips' inner landmarks, from corner to corner
_LIPS = 0.16  # of the mouth's width: so far from their rims, lips follow these
_WIDE = 0.12  # of the mouth's width: lips that are farther apart are not sealed
_FEWEST_LANDMARKS = 6
_ODD_SIZE = 0.2  # logarithm: a scan that has grown or shrunk by more is held at the size that its landmarks have


def shut_eyes(landmarks: ScanLandmarks, shapes: Collection[str]) -> dict[str, float]:
    """The blinks among a face's shapes of the eyes whose lids' landmarks meet, with weight 1."""
    shut = {}
    for side, first in (("Left", 42), ("Right", 36)):
        outer, *upper, inner, low_inner, low_outer = landmarks.points[first : first + 6]
        apart = sum(np.linalg.norm(one - low) for one, low in zip(upper, (low_outer, low_inner), strict=True))
        name = next((name for name in (f"eyeBlink{side}", f"eyeBlink_{side[0]}") if name in shapes), None)
        if name is not None and apart < 2 * _SHUT * np.linalg.norm(inner - outer):  # not where one is unknown
            shut[name] = 1.0
    return shut


def are_sealed(landmarks: ScanLandmarks) -> bool:
    """Whether the landmarks of both lips meet; not where one is unknown."""
    upper, lower = (landmarks.points[list(rim)] for rim in (_UPPER, _LOWER))
    width = np.linalg.norm(upper[-1] - upper[0])
    return bool(np.linalg.norm(upper - lower, axis=1)[1:-1].mean() < _SEALED * width)


def with_sealed_lips(template: Template, points: FloatArray) -> FloatArray:
    """Whole points (n, 3) with both rims of the lips halfway between where they are, and the lips drawn after them.

    The rims of sealed lips lie in a crease, where no point of the scan faces as they do.
    """
    surface = surface_of(template.parts, template.where)
    assert surface.landmarks is not None
    rims = [points_between(surface, surface.landmarks[list(marks)]) for marks in (_UPPER, _LOWER)]
    above, below = graph_distances(surface.graph, rims)[:, surface.group]
    start, end = points[template.rows[template.landmarks[[_UPPER[0], _UPPER[-1]]]]]
    width = float(np.linalg.norm(end - start))
    along = (points - start) @ (end - start) / width**2
    upper, lower = (_on_rim(points, along, np.flatnonzero(np.isin(surface.group, rim))) for rim in rims)
    gap = upper - lower
    # Across the mouth alone: a rim found a little too far along would draw the lips sideways.
    gap -= np.outer(gap @ (end - start), end - start) / width**2
    if np.linalg.norm(gap, axis=1).max() > _WIDE * width:
        return points
    share = 1.0 - smoothstep(np.minimum(above, below) / (_LIPS * width))
    way = 0.5 * share * ((below < above) * 1.0 - (above < below) * 1.0)
    return np.asarray(points + way[:, None] * gap)


def _on_rim(points: FloatArray, along: FloatArray, rim: IntArray) -> FloatArray:
    """(n, 3) where a rim is, as far along the mouth as each point (n, 3)."""
    rim = rim[np.argsort(along[rim], kind="stable")]
    return np.stack([np.interp(along, along[rim], column) for column in points[rim].T], axis=1)


@dataclass(frozen=True, kw_only=True)
class NeutralReport(Report):
    """How a neutral lies on its scan."""

    fit: ScanFit
    quality: Quality  # what a database asks for
    coefficients: tuple[float, ...]  # of the identity model, in standard deviations
    residual_mean_mm: float  # what the model could not show, over the face area
    residual_max_mm: float
    weights: Mapping[str, float] = field(default_factory=dict)  # of shapes that the scan shows besides, as found


@dataclass(frozen=True, kw_only=True)
class NeutralFit:
    """An actor's neutral."""

    points: FloatArray  # (n, 3) whole points, in the template's place
    expression: FloatArray  # (n, 3) whole delta that the scan shows besides
    place: Similarity  # from the scan's coordinates to those
    report: NeutralReport


@dataclass(frozen=True, kw_only=True)
class FitNeutral:
    """Identity coefficients, the scan's place and size, and a smooth residual, solved together on matches that are
    renewed from step to step.

    The document (S13) solves them one after another; what the model can't show then bends its coefficients, and leaves
    0.1 mm more. Points that no scan shows (back of the mouth, eyeballs, teeth) follow the model and the skin around.
    """

    options: FitNeutralOptions = field(default_factory=FitNeutralOptions)

    @one_thread()
    def __call__(
        self,
        template: Template,
        scan: Scan,
        landmarks: ScanLandmarks,
        database: FaceDatabase,
        progress: Callable[[int], None] = lambda step: None,
        weights: Mapping[str, float] | None = None,
    ) -> NeutralFit:
        """Fit the neutral.

        :param weights: of the template's shapes that the scan shows besides, such as closed eyes; the neutral is
            without them
        :raises InputError: too few landmarks, a mirrored scan, a wrong unit, a shape that the template lacks, or
            a scan that can't be used
        :raises TopologyError: a database of another topology
        :raises FitError: a scan that does not show this face
        """
        if database.topology.digest != template.topology.digest:
            raise TopologyError(template.where, "other meshes or faces than the database has, expected the same")
        marks = template.rows[template.landmarks]
        start, warnings = self._start(scan, landmarks, database.identity.mean[marks])
        shapes = ShownShapes.carried_over(template, database, weights or {}, f"{scan.name} -> weights")
        target, mended = scan_target(scan)
        surface = identity_surface(template, database.identity, self.options)
        anchors = landmark_anchors(template, landmarks)
        shown = shapes.prior(template, self.options.weight_sigma)
        options = self.options.registration
        try:
            registered = register(surface, target, anchors, start, options, progress, shown)
            if abs(np.log(registered.place.scale / start.scale)) > _ODD_SIZE:
                registered = register(surface, target, anchors, start, replace(options, scale=False), progress, shown)
        except FitError as error:
            raise error.under(scan.name) from None
        lines = (*scan.warnings, *mended, *warnings)
        return neutral_fit(template, database.identity, scan.name, registered, anchors.names, lines, shapes)

    def _start(self, scan: Scan, landmarks: ScanLandmarks, reference: FloatArray) -> tuple[Similarity, tuple[str, ...]]:
        """About where the scan lies, by its landmarks."""
        known = landmarks.known
        where = f"{scan.name} -> landmarks"
        if known.sum() < _FEWEST_LANDMARKS:
            raise InputError(where, f"{int(known.sum())} of 68 are known, expected {_FEWEST_LANDMARKS} or more")
        if mirrored(landmarks.points[known], reference[known]):
            raise InputError(where, "fit a mirrored face, expected left and right as the person has them")
        free = robust_similarity(landmarks.points[known], reference[known])
        if self.options.unit == "auto":
            return free, ()
        size = UNITS[self.options.unit]
        if abs(free.scale / size - 1.0) > 0.3:
            size_of = unit_of(free.scale) or f"units of {free.scale:.3g} mm"
            raise InputError(scan.name, f"was given in {self.options.unit}, but has the size of a face in {size_of}")
        held = robust_similarity(landmarks.points[known] * size, reference[known], scale=False)
        return replace(held, scale=size), ()


def identity_surface(template: Template, identity: IdentityModel, options: FitNeutralOptions) -> DeformableSurface:
    """The template's skin by the identity model."""
    modes = identity.components[:, template.rows] * identity.deviations[:, None, None]
    return DeformableSurface(
        base=identity.mean[template.rows],
        modes=modes,
        expected=np.zeros(len(modes)),
        precision=np.full(len(modes), options.prior),
        triangles=template.triangles,
        seen=template.seen,
        held=np.zeros(len(template.rows)),
        labels=template.labels,
    )


def landmark_anchors(template: Template, landmarks: ScanLandmarks) -> Anchors:
    """The landmarks that are known, held as they say, else as the options of a fit do; named from 0, as in files."""
    names = tuple(f"landmark {number}" for number in range(len(landmarks.points)))
    return Anchors.at_points(template.landmarks, landmarks.points, names, landmarks.sigma_mm)


def neutral_fit(
    template: Template,
    identity: IdentityModel,
    scan: str,
    registered: Registered,
    names: tuple[str, ...],
    warnings: tuple[str, ...],
    shapes: ShownShapes | None = None,
) -> NeutralFit:
    """Whole points and the report of what was found on a scan.

    :param names: of the anchors
    :param warnings: from before
    :param shapes: those that the scan shows besides
    """
    shapes = shapes or ShownShapes()
    weights = dict(zip(shapes.weights, map(float, registered.weights), strict=True))
    model = identity.points(registered.coefficients)
    expression = shapes.expression(weights, len(model))
    base = model[template.rows]
    # a scan is model + expression + residual; the neutral is model + residual.
    moves = template.with_inside(base, registered.points - expression[template.rows] - base)
    points = template.whole(model, base + moves)
    fit = scan_fit(scan, registered, template.face, names)
    off = np.linalg.norm(registered.residual[template.face], axis=1)
    # triangles count as flipped against what the identity model shows of this person: people's own corners of lips and
    # lids turn some against the template's
    flipped = flipped_triangles(model, points, template.topology.triangles)
    report = NeutralReport(
        fit=fit,
        quality=Quality(
            surface_mean_mm=fit.surface_mean_mm,
            surface_p95_mm=fit.surface_p95_mm,
            coverage=fit.coverage,
            flipped_triangles=int(flipped.sum()),
        ),
        coefficients=tuple(float(coefficient) for coefficient in registered.coefficients),
        residual_mean_mm=float(off.mean()) if len(off) else 0.0,
        residual_max_mm=float(off.max(initial=0.0)),
        weights=weights,
        warnings=(*warnings, *_fit_warnings(scan, fit)),
    )
    return NeutralFit(points=points, expression=expression, place=registered.place, report=report)


def _fit_warnings(name: str, fit: ScanFit) -> tuple[str, ...]:
    """What a user should know of the fit."""
    lines = []
    if fit.unit != "mm":
        size = f"1 unit is {fit.mm_per_unit:.4g} mm"
        lines.append(f"{name}: {size}, {_unit_text(fit) if fit.unit else 'like no usual unit'}")
    if fit.outliers:
        some = first_names(fit.outliers, 6)
        lines.append(f"{name}: {len(fit.outliers)} landmarks ignored as outliers: {some}")
    return tuple(lines)


def _unit_text(fit: ScanFit) -> str:
    held = abs(fit.mm_per_unit / UNITS[str(fit.unit)] - 1.0) < 1e-9
    return f"taken as {fit.unit}" + ("" if held else f" by its shape (--unit {fit.unit} holds the size)")
