"""The actor's neutral from its scan, an identity model and a smooth residual (document S13)."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import FitError, InputError, TopologyError
from facepipe.core.names import first_names
from facepipe.core.reports import not_in_json
from facepipe.core.threads import one_thread
from facepipe.geometry.geodesics import graph_distances
from facepipe.geometry.identity_model import IdentityModel
from facepipe.geometry.landmarks import mirrored
from facepipe.geometry.polygons import flipped_triangles
from facepipe.geometry.registration import STAGES, Anchors, DeformableSurface, Registered, register
from facepipe.geometry.similarity import Similarity, robust_similarity
from facepipe.scanning.database import FaceDatabase, Quality
from facepipe.scanning.rebuild.declared import UNITS, FitNeutralOptions, Judged
from facepipe.scanning.rebuild.scan_fit import ScanFit, scan_fit, scan_target, unit_of
from facepipe.scanning.rebuild.template import Template, carried_over, expression_of, shown_prior
from facepipe.scans import Scan, ScanLandmarks
from facepipe.verbs.skin.surface import points_between, smoothstep

_SHUT = 0.21  # of an eye's width, that lids' landmarks are apart; those found on a real scan's shut eyes are 0.2
_SEALED = 0.03  # of the mouth's width, that lips' landmarks are apart
_UPPER, _LOWER = (60, 61, 62, 63, 64), (60, 67, 66, 65, 64)  # the lips' inner landmarks, from corner to corner
_LIPS = 0.16  # of the mouth's width: so far from their rims, lips follow these
_WIDE = 0.12  # of the mouth's width: lips that are farther apart are not sealed
_FEWEST_LANDMARKS = 6
_ODD_SIZE = 0.2  # logarithm: a scan that has grown or shrunk by more is held at the size that its landmarks have
_USUAL = FitNeutralOptions()


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
    surface = template.surface
    assert surface.landmarks is not None
    rims = [points_between(surface, surface.landmarks[list(marks)]) for marks in (_UPPER, _LOWER)]
    above, below = graph_distances(surface.graph, rims)[:, surface.group]
    start, end = points[template.rows[template.landmarks[[_UPPER[0], _UPPER[-1]]]]]
    width = float(np.linalg.norm(end - start))
    along = (points - start) @ (end - start) / width**2
    on_rims = []  # (n, 3) where a rim is, as far along the mouth as each point
    for rim in rims:
        ordered = np.flatnonzero(np.isin(surface.group, rim))
        ordered = ordered[np.argsort(along[ordered], kind="stable")]
        on_rims.append(np.stack([np.interp(along, along[ordered], column) for column in points[ordered].T], axis=1))
    gap = on_rims[0] - on_rims[1]
    # Across the mouth alone: a rim found a little too far along would draw the lips sideways.
    gap -= np.outer(gap @ (end - start), end - start) / width**2
    if np.linalg.norm(gap, axis=1).max() > _WIDE * width:
        return points
    share = 1.0 - smoothstep(np.minimum(above, below) / (_LIPS * width))
    way = 0.5 * share * ((below < above) * 1.0 - (above < below) * 1.0)
    return np.asarray(points + way[:, None] * gap)


@dataclass(frozen=True, kw_only=True)
class FitNeutralReport(Judged):
    """How a neutral lies on its scan, and what `facepipe fit-neutral` made of it."""

    fit: ScanFit
    quality: Quality  # what a database asks for
    coefficients: tuple[float, ...]  # of the identity model, in standard deviations
    residual_mean_mm: float  # what the model could not show, over the face area
    residual_max_mm: float
    weights: Mapping[str, float] = field(default_factory=dict)  # of shapes that the scan shows besides, as found
    textures: Mapping[str, tuple[str, ...]] = field(default_factory=dict)  # file -> the materials that show it
    colored: float = 0.0  # share of the skin's outside whose colours the scan shows
    hidden: tuple[str, ...] = ()  # materials of cards of brows, which the scan's colours show
    photos: Mapping[str, Any] = field(default_factory=dict)  # what `facepipe scan` reports of them
    own_shapes: tuple[str, ...] = ()  # of the head that it was fitted to, as `facepipe conform` brings them
    place: Any = not_in_json()  # `Similarity` from the scan's coordinates to the face's whole points

    of_action: ClassVar[tuple[str, ...]] = ("textures", "colored", "hidden", "photos", "own_shapes")


@dataclass(frozen=True, kw_only=True)
class NeutralScan:
    """An actor's neutral, and how a scan shows it."""

    points: FloatArray  # (n, 3) whole points, in the template's place, millimetres
    # From its scan's coordinates; None where there is none: sizes of scans are fitted, and markers are ignored.
    place: Similarity | None = None
    landmarks: ScanLandmarks = field(default_factory=ScanLandmarks)  # markers on it are followed
    expression: FloatArray | None = None  # (n, 3) whole delta that its scan shows besides; None: none

    @property
    def shown(self) -> FloatArray:
        """(n, 3) whole points as its scan shows them."""
        return self.points if self.expression is None else self.points + self.expression


@one_thread()
def fit_neutral(
    template: Template,
    scan: Scan,
    landmarks: ScanLandmarks,
    database: FaceDatabase,
    options: FitNeutralOptions = _USUAL,
    progress: Callable[[int], None] = lambda step: None,
    weights: Mapping[str, float] | None = None,
    *,
    roughly: bool = False,
) -> tuple[NeutralScan, Similarity, FitNeutralReport]:
    """The neutral, the place of its scan, and how it lies there.

    Identity coefficients, the scan's place and size, and a smooth residual are solved together, on matches that are
    renewed from step to step. The document (S13) solves them one after another; what the model can't show then bends
    its coefficients, and leaves 0.1 mm more. Points that no scan shows (back of the mouth, eyeballs, teeth) follow the
    model and the skin around.

    :param weights: of the template's shapes that the scan shows besides, such as closed eyes; the neutral is without
        them
    :param roughly: as a start for more: of the size that its landmarks have, and without the last steps
    :raises InputError: too few landmarks, a mirrored scan, a wrong unit, a shape that the template lacks, or a scan
        that can't be used
    :raises TopologyError: a database of another topology
    :raises FitError: a scan that does not show this face
    """
    if database.topology.digest != template.topology.digest:
        raise TopologyError(template.where, "other meshes or faces than the database has, expected the same")
    marks = template.rows[template.landmarks]
    known, where = landmarks.known, f"{scan.name} -> landmarks"
    if known.sum() < _FEWEST_LANDMARKS:
        raise InputError(where, f"{int(known.sum())} of 68 are known, expected {_FEWEST_LANDMARKS} or more")
    given, reference = landmarks.points[known], database.identity.mean[marks][known]
    if mirrored(given, reference):
        raise InputError(where, "fit a mirrored face, expected left and right as the person has them")
    start = robust_similarity(given, reference)  # about where the scan lies
    if options.unit != "auto":
        size = UNITS[options.unit]
        if abs(start.scale / size - 1.0) > 0.3:
            size_of = unit_of(start.scale) or f"units of {start.scale:.3g} mm"
            raise InputError(scan.name, f"was given in {options.unit}, but has the size of a face in {size_of}")
        start = replace(robust_similarity(given * size, reference, scale=False), scale=size)
    deltas, weights = carried_over(template, database, weights or {}, f"{scan.name} -> weights")
    target, mended = scan_target(scan)
    surface = identity_surface(template, database.identity, options)
    anchors = landmark_anchors(template, landmarks)
    shown = shown_prior(template, deltas, weights, options.weight_sigma)
    solver = options.registration
    solver, stages = replace(solver, scale=solver.scale and not roughly), STAGES[:2] if roughly else STAGES
    try:
        registered = register(surface, target, anchors, start, solver, progress, shown, stages, _ODD_SIZE)
    except FitError as error:
        raise error.under(scan.name) from None
    lines = (*scan.warnings, *mended)
    neutral, report = found_neutral(template, database.identity, scan.name, registered, anchors.names, lines, deltas)
    return replace(neutral, landmarks=landmarks), registered.place, report


def identity_surface(template: Template, identity: IdentityModel, options: FitNeutralOptions) -> DeformableSurface:
    """The template's skin by the identity model."""
    modes = identity.components[:, template.rows]
    modes *= identity.deviations[:, None, None]
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


def found_neutral(
    template: Template,
    identity: IdentityModel,
    scan: str,
    registered: Registered,
    names: tuple[str, ...],
    warnings: tuple[str, ...],
    deltas: Mapping[str, FloatArray],
) -> tuple[NeutralScan, FitNeutralReport]:
    """What was found on a scan, in whole points, and the report of it.

    :param names: of the anchors
    :param warnings: from before
    :param deltas: of the shapes that the scan shows besides
    """
    weights = dict(zip(deltas, map(float, registered.weights), strict=True))
    model = identity.points(registered.coefficients)
    expression = expression_of(deltas, weights, len(model))
    base = model[template.rows]
    # a scan is model + expression + residual; the neutral is model + residual.
    moves = template.with_inside(base, registered.points - expression[template.rows] - base)
    points = template.whole(model, base + moves)
    fit = scan_fit(scan, registered, template.face, names)
    off = np.linalg.norm(registered.residual[template.face], axis=1)
    # triangles count as flipped against what the identity model shows of this person: people's own corners of lips and
    # lids turn some against the template's
    flipped = flipped_triangles(model, points, template.topology.triangles)
    lines = list(warnings)
    if fit.unit != "mm":
        taken = "like no usual unit"
        if fit.unit:
            held = abs(fit.mm_per_unit / UNITS[fit.unit] - 1.0) < 1e-9
            taken = f"taken as {fit.unit}" + ("" if held else f" by its shape (--unit {fit.unit} holds the size)")
        lines.append(f"{scan}: 1 unit is {fit.mm_per_unit:.4g} mm, {taken}")
    if fit.outliers:
        lines.append(f"{scan}: {len(fit.outliers)} landmarks ignored as outliers: {first_names(fit.outliers, 6)}")
    report = FitNeutralReport(
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
        warnings=tuple(lines),
    )
    return NeutralScan(points=points, place=registered.place, expression=expression if deltas else None), report


def FitNeutral(**options: FitNeutralOptions) -> Callable[..., SimpleNamespace]:  # noqa: N802
    """As in 0.1.0, which had a class of that name: `fit_neutral` with its `options`, and what that finds."""

    def fit(*given: Any, **more: Any) -> SimpleNamespace:
        named = {**options, **dict(zip(("progress", "weights"), given[4:], strict=False)), **more}
        neutral, place, report = fit_neutral(*given[:4], **named)
        shown = neutral.shown - neutral.points
        return SimpleNamespace(points=neutral.points, expression=shown, place=place, report=report)

    return fit
