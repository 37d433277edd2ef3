"""Scanned expressions: registered by `facepipe register-scan`, and again from their recipes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from facepipe.importers.scan_file import read_scan
from facepipe.kinds import Watch
from facepipe.pipeline.rebuild_stage import Made
from facepipe.pipeline.register_job import RegisterJob, recipe_job
from facepipe.pipeline.verbs import Cooked
from facepipe.processors.database import Quality, QualityLimits, WholeFace, misses, whole_face
from facepipe.processors.rebuild import (
    CompositeReport,
    ExpressionScan,
    NeutralScan,
    RegisteredComposite,
    RegisterScans,
    Template,
    resolved,
)
from facepipe.processors.rebuild.expression_file import author_expression
from facepipe.processors.rebuild.neutral_place import placed_neutral
from facepipe.processors.rebuild.scan_input import landmarks_of, named
from facepipe.processors.rebuild.shown_shapes import ShownShapes
from facepipe.scans import Scan
from facepipe.stage import open_face

_STEPS = 18  # of a registration, at most

Seen = Callable[[Template, Scan, RegisteredComposite], object]


def cook(path: Path, watch: Watch) -> Cooked:
    """Register again in the place of the result at `path`.

    :raises FacepipeError: a recipe or sources that can't be read, or that can't be fitted
    """
    made = make(recipe_job(path), watch)
    return Cooked(report=made.report, missed=bool(made.missed))


def make(job: RegisterJob, watch: Watch, seen: Seen = lambda template, scan, composite: None) -> Made[CompositeReport]:
    """Read, register, author, save.

    :param seen: called with the result before it is saved
    :raises FacepipeError: what can't be read, fitted or written
    """
    register, face = RegisterScans(options=job.options), open_face(job.personal)
    parts = face.parts()
    own = whole_face(parts, str(job.personal))
    weights = job.resolved(tuple(own.deltas))
    template = Template.of(parts, str(job.personal))
    scan = read_scan(job.scan)
    landmarks, found = landmarks_of(job.landmarks, scan)
    neutral, told = _neutral(job, template, own)
    given = ExpressionScan(scan=scan, landmarks=landmarks, weights=weights)
    with named(job.scan), watch("register", _STEPS) as bar:
        composite = register(template, neutral, own.deltas, given, lambda step: bar.update())
        missed = _misses(composite.report)
    recipe = job.recipe(weights, composite.weights, composite.report.fit)
    with face.deriving(job.out, flatten=job.flatten) as derived:
        with named(job.personal):
            authored = author_expression(derived, job.name, own.points, composite, recipe)
        seen(template, scan, composite)
    unused = ("markers don't count without --neutral-scan",) if landmarks.markers and neutral.place is None else ()
    warnings = (*found, *told, *unused, *composite.report.warnings, *authored.warnings, *missed)
    return Made(replace(composite.report, warnings=warnings), missed)


def _neutral(job: RegisterJob, template: Template, own: WholeFace) -> tuple[NeutralScan, tuple[str, ...]]:
    """The neutral, with the place of its scan where one is given, and what there is to say of that."""
    if job.neutral_scan is None:
        return NeutralScan(points=own.points), ()
    expression = None
    if job.neutral_weights:
        shown = resolved(job.neutral_weights, tuple(own.deltas), "--neutral-weights")
        expression = ShownShapes(deltas=own.deltas, weights=shown).expression(shown, len(own.points))
    scan = read_scan(job.neutral_scan)
    landmarks, found = landmarks_of(job.neutral_landmarks, scan)
    with named(job.neutral_scan):
        return placed_neutral(template, own.points, scan, landmarks, expression), found


def _misses(report: CompositeReport) -> tuple[str, ...]:
    fit = report.fit
    quality = Quality(
        surface_mean_mm=fit.surface_mean_mm,
        surface_p95_mm=fit.surface_p95_mm,
        coverage=fit.coverage,
        flipped_triangles=0,  # those are counted of shapes
    )
    return misses(quality, QualityLimits())
