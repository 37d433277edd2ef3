"""Rebuild: from a project's scans to the actor's neutral and shapes, step by step (document S13 to S16)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.geometry.polygons import flipped_triangles
from facepipe.geometry.similarity import Similarity
from facepipe.scanning.database import FaceDatabase, Quality, quality_from
from facepipe.scanning.rebuild.fit_steps import FitSteps
from facepipe.scanning.rebuild.personal_template import PersonalTemplate
from facepipe.scanning.rebuild.project import Project, expression_weights
from facepipe.scanning.rebuild.scan_check import ScanCheck, ScanChecks, misfits
from facepipe.scanning.rebuild.step_results import Fitted, FittedExpression, FittedNeutral
from facepipe.scanning.rebuild.steps import Steps
from facepipe.scanning.rebuild.template import Template, region_weights

_ALONE = "alone/"  # folder of what a joint fit begins with


@dataclass(frozen=True, kw_only=True)
class Rebuilt:
    """An actor's face, and how it came about."""

    neutral: FloatArray  # (n, 3) whole points, millimetres
    shapes: Mapping[str, FloatArray]  # name -> (n, 3) whole delta
    reports: Mapping[str, Mapping[str, Any]]  # step -> its report: "neutral", "refined", "expressions/NAME", "shapes"
    personal: Mapping[str, FloatArray]  # name -> (n, 3) whole delta of the personal template
    shown: FloatArray  # (n, 3) whole points of the neutral as its scan shows them, with closed eyes for example
    composites: Mapping[str, FloatArray]  # expression -> (n, 3) whole points
    checks: Mapping[str, ScanCheck]  # expression -> whether its scan belongs
    left_out: Mapping[str, str]  # expression -> why its scan does not belong
    places: Mapping[str, Similarity]  # step of a scan -> from the scan's coordinates to those of the points
    quality: Quality  # of neutral and shapes, for a database
    reused: tuple[str, ...]  # steps whose results were there
    corrected: tuple[str, ...]  # results that a corrected mesh replaced
    warnings: tuple[str, ...]


def is_joint(project: Project) -> bool:
    """Whether the neutral is refined on all scans together."""
    return project.joint and bool(project.expressions)


def step_count(project: Project) -> int:
    """How many steps a project has."""
    scans = len(project.expressions)
    once = 2 + scans + bool(scans) + (project.refinement is not None)
    return once + (2 + scans) * is_joint(project)


class Rebuild:
    """One run of a project over its work folder.

    :param began: called with the name of each step as it begins
    :raises InputError: a work folder that can't be made
    """

    def __init__(
        self, project: Project, template: Template, began: Callable[[str], object] = lambda name: None
    ) -> None:
        self._project, self._template = project, template
        self._steps = Steps(project, template, began)
        self._checks: dict[str, ScanCheck] = {}
        self._left_out: dict[str, str] = {}

    def __call__(self) -> Rebuilt:
        """All steps.

        :raises FacepipeError: what can't be read, fitted or written; the results of the steps before stay
        """
        _check_names(self._project, self._template, self._steps.database())
        fits = FitSteps(self._steps)
        neutral = self._neutral(fits)
        steps: dict[str, Fitted] = {"neutral": neutral}
        if self._project.refinement is not None:
            neutral = steps["refined"] = fits.refined(neutral, self._project.refinement)
        points = neutral.scan.points
        start = shapes = fits.personal(points)
        expressions = {scan.name: fits.expression(scan, neutral.scan, shapes) for scan in self._project.expressions}
        steps |= {f"expressions/{name}": one for name, one in expressions.items()}
        reports = {name: one.report for name, one in steps.items()}
        composites = {name: one.composite for name, one in self._belonging(points, shapes, expressions).items()}
        if composites:
            shapes, reports["shapes"] = fits.split(points, shapes, composites)
        shapes = fits.corrected_shapes(points, shapes)
        lines = [line for report in reports.values() for line in report.get("warnings", ())]
        return Rebuilt(
            neutral=points,
            shapes=shapes,
            reports=reports,
            personal=start,
            shown=neutral.scan.shown,
            composites={name: one.composite.points for name, one in expressions.items()},
            checks=self._checks,
            left_out=self._left_out,
            places={name: one.place for name, one in steps.items()},
            quality=self._quality(neutral, start, shapes),
            reused=tuple(self._steps.reused),
            corrected=tuple(self._steps.corrected),
            warnings=(*lines, *self._left_shapes(shapes), *self._steps.idle_corrections()),
        )

    def _neutral(self, fits: FitSteps) -> FittedNeutral:
        """On its scan alone, or on all scans together, which begins with fits to each."""
        if not is_joint(self._project):
            return fits.neutral()
        alone = FitSteps(self._steps, below=_ALONE)
        first = alone.neutral()
        shapes = alone.personal(first.scan.points)
        found = {scan.name: alone.expression(scan, first.scan, shapes) for scan in self._project.expressions}
        belonging = self._belonging(first.scan.points, shapes, found)
        return fits.together(first, shapes, belonging) if belonging else fits.neutral()

    def _belonging(
        self, neutral: FloatArray, shapes: Mapping[str, FloatArray], found: Mapping[str, FittedExpression]
    ) -> dict[str, FittedExpression]:
        """Those of the expressions whose scans belong to the actor, now and before, or that an artist has corrected."""
        checks = ScanChecks(self._template, neutral, shapes)
        self._checks |= {name: checks.check(one.composite, one.report["fit"]) for name, one in found.items()}
        asked = {name: one.composite.weights for name, one in found.items()}
        self._left_out |= {
            name: reason
            for name, reason in misfits(self._checks, asked).items()
            if not self._steps.has_correction(f"expressions/{name}")
        }
        return {name: one for name, one in found.items() if name not in self._left_out}

    def _quality(
        self, neutral: FittedNeutral, start: Mapping[str, FloatArray], shapes: Mapping[str, FloatArray]
    ) -> Quality:
        """The neutral's, and triangles that some shape turns where the personal template does not."""
        quality, triangles = quality_from(neutral.report["quality"], "neutral"), self._template.topology.triangles
        turned, points = np.zeros(len(triangles), bool), neutral.scan.points
        for name, delta in shapes.items():
            if delta is not start[name]:
                turned |= flipped_triangles(points + start[name], points + delta, triangles)
        return replace(quality, flipped_triangles=quality.flipped_triangles + int(turned.sum()))

    def _left_shapes(self, shapes: Mapping[str, FloatArray]) -> tuple[str, ...]:
        own = {*self._template.parts.shapes}
        left = sorted(own - set(shapes))
        where = self._template.where
        return (f"{where}: the database lacks {', '.join(left)}: the template's offsets are kept",) if left else ()


def _check_names(project: Project, template: Template, database: FaceDatabase) -> None:
    """All regions and shapes that a project names are there: asked before the first fit, as fits take minutes.

    :raises FacepipeError: one that is not, or a database that starting shapes can't come from
    """
    if project.refinement is not None:
        region_weights(template.parts, project.refinement.regions, f"{project.path} -> options.refinement")
    shapes = PersonalTemplate(options=project.template_options).names(template, database)
    for scan in project.expressions:
        expression_weights(project, scan, shapes)
