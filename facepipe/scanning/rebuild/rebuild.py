"""Rebuild: from a project's scans to the actor's neutral and shapes, step by step (document S13 to S16)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.geometry.polygons import flipped_triangles
from facepipe.geometry.similarity import Similarity
from facepipe.scanning.database import FaceDatabase, Quality, quality_from
from facepipe.scanning.rebuild.fit_neutral import FitNeutral
from facepipe.scanning.rebuild.personal_template import PersonalTemplate
from facepipe.scanning.rebuild.project import Project, ProjectScan, Refinement, expression_weights
from facepipe.scanning.rebuild.refine_neutral import RefineNeutral
from facepipe.scanning.rebuild.register_scans import (
    Composite,
    ExpressionScan,
    FitTogether,
    NeutralScan,
    PlacedExpression,
    RegisterScans,
)
from facepipe.scanning.rebuild.scan_check import ScanCheck, ScanChecks, misfits
from facepipe.scanning.rebuild.split_expressions import SplitExpressions
from facepipe.scanning.rebuild.steps import (
    EXPRESSION,
    NEUTRAL,
    REFINED,
    SHAPES,
    TEMPLATE,
    Fitted,
    FittedExpression,
    FittedNeutral,
    StepResult,
    Steps,
    array_digest,
    place_json,
    place_of,
    shape_arrays,
    shapes_of,
)
from facepipe.scanning.rebuild.template import Template, region_weights

Shapes = Mapping[str, FloatArray]
Expressions = Mapping[str, FittedExpression]
_ALONE = "alone/"  # folder of what a joint fit begins with


class FitSteps:
    """Each fit from the results of those before it, kept in the work folder.

    :param below: folder of the results, ending in a slash; of expressions there, no more than weights and places is
        used, and no correction
    """

    def __init__(self, steps: Steps, *, below: str = "") -> None:
        self._steps, self._project, self._template = steps, steps.project, steps.template
        self._below = below

    def neutral(self) -> FittedNeutral:
        """:raises FacepipeError: what can't be read, fitted or written"""
        project, steps = self._project, self._steps

        def compute() -> tuple[dict[str, Any], dict[str, Any]]:
            scan, marks = steps.read(project.neutral)
            fit_neutral = FitNeutral(options=project.neutral_options)
            fit = fit_neutral(self._template, scan, marks, steps.database(), weights=project.neutral.weights)
            arrays = {"points": fit.points, "expression": fit.expression}
            return arrays, {"report": fit.report.to_dict(), "place": place_json(fit.place)}

        inputs = steps.inputs(project.neutral, project.neutral_options, database=steps.digest(project.database))
        inputs |= {"weights": dict(project.neutral.weights), "keeps": ["points", "expression", "report", "place"]}
        return self._neutral(steps.step(f"{self._below}neutral", inputs, compute, NEUTRAL))

    def together(self, first: FittedNeutral, shapes: Shapes, expressions: Expressions) -> FittedNeutral:
        """The neutral refined on all scans, from fits to each alone.

        :param shapes: the personal template of `first`
        :raises FacepipeError: what can't be read, fitted or written
        """
        project, steps = self._project, self._steps
        scans = {scan.name: scan for scan in project.expressions}
        coefficients = np.array(first.report["coefficients"])

        def compute() -> tuple[dict[str, Any], dict[str, Any]]:
            placed = []
            for name, one in expressions.items():
                raw, marks = steps.read(scans[name])
                given = ExpressionScan(scan=raw, landmarks=marks, weights=one.composite.weights)
                placed.append(PlacedExpression(expression=given, place=one.place))
            raw, marks = steps.read(project.neutral)
            neutral = replace(first.scan, landmarks=marks)
            fit_together = FitTogether(neutral=project.neutral_options, expressions=project.expression_options)
            fit = fit_together(self._template, raw, neutral, coefficients, steps.database(), shapes, placed)
            weights = dict(zip(expressions, fit.weights, strict=True))
            report = fit.neutral.report.to_dict()
            report["weights"] = _shown_weights(report["weights"], first.report["weights"])
            report["together"] = {"moved_mean_mm": fit.moved_mean_mm, "weights": weights}
            arrays = {"points": fit.neutral.points, "expression": fit.neutral.expression}
            return arrays, {"report": report, "place": place_json(fit.neutral.place)}

        inputs = steps.inputs(project.neutral, project.neutral_options, database=steps.digest(project.database))
        inputs |= {
            "first": array_digest(first.scan.points, first.scan.shown, coefficients),
            "weights": dict(first.report["weights"]),
            "place": place_json(first.place),
            "shapes": array_digest(*shapes.values()),
        }
        inputs["expressions"] = {}
        for name, one in expressions.items():
            found = {"weights": dict(one.composite.weights), "place": place_json(one.place)}
            inputs["expressions"][name] = steps.inputs(scans[name], project.expression_options, **found)
        return self._neutral(steps.step(f"{self._below}neutral", inputs, compute, NEUTRAL))

    def _neutral(self, result: StepResult) -> FittedNeutral:
        points = self._steps.after_correction(f"{self._below}neutral", result.arrays["points"])
        landmarks = self._steps.landmarks(self._project.neutral)
        place = place_of(result.content["place"])
        expression = result.arrays["expression"] if self._project.neutral.weights else None
        scan = NeutralScan(points=points, place=place, landmarks=landmarks, expression=expression)
        return FittedNeutral(scan=scan, place=place, report=result.content["report"])

    def refined(self, neutral: FittedNeutral, refinement: Refinement) -> FittedNeutral:
        """The neutral drawn closer to its scan, as corrected.

        :raises FacepipeError: an unknown region, or what can't be read, fitted or written
        """
        project, steps = self._project, self._steps
        where = f"{project.path} -> options.refinement"
        weights = region_weights(self._template.parts, refinement.regions, where)
        points, flipped = neutral.scan.points, quality_from(neutral.report["quality"], "neutral").flipped_triangles

        def compute() -> tuple[dict[str, Any], dict[str, Any]]:
            scan, marks = steps.read(project.neutral)
            refine = RefineNeutral(options=refinement.options)
            expression = neutral.scan.expression
            result = refine(self._template, points, scan, marks, neutral.place, weights, expression, flipped=flipped)
            return {"points": result.points}, {"report": result.report.to_dict()}

        inputs = steps.inputs(project.neutral, refinement.options, neutral=array_digest(points, neutral.scan.shown))
        inputs |= {"regions": list(refinement.regions), "place": place_json(neutral.place), "flipped": flipped}
        result = steps.step("refined", inputs, compute, REFINED)
        scan = replace(neutral.scan, points=steps.after_correction("refined", result.arrays["points"]))
        return FittedNeutral(scan=scan, place=neutral.place, report=result.content["report"])

    def personal(self, neutral: FloatArray) -> dict[str, FloatArray]:
        """The starting shapes of `neutral` (n, 3).

        :raises FacepipeError: what can't be read, made or written
        """
        project, steps = self._project, self._steps

        def compute() -> tuple[dict[str, Any], dict[str, Any]]:
            shapes = PersonalTemplate(options=project.template_options)(self._template, neutral, steps.database())
            return shape_arrays(shapes), {"names": list(shapes)}

        inputs = {
            "neutral": array_digest(neutral),
            "template": steps.digest(project.template),
            "database": steps.digest(project.database),
            "options": asdict(project.template_options),
        }
        result = steps.step(f"{self._below}template", inputs, compute, TEMPLATE)
        return shapes_of(result.arrays, result.content["names"])

    def expression(self, scan: ProjectScan, neutral: NeutralScan, shapes: Shapes) -> FittedExpression:
        """One expression from the neutral and its shapes.

        :raises FacepipeError: what can't be read, fitted or written
        """
        options, steps = self._project.expression_options, self._steps
        weights = expression_weights(self._project, scan, tuple(shapes))

        def compute() -> tuple[dict[str, Any], dict[str, Any]]:
            raw, marks = steps.read(scan)
            given = ExpressionScan(scan=raw, landmarks=marks, weights=weights)
            result = RegisterScans(options=options)(self._template, neutral, shapes, given)
            content = {"report": result.report.to_dict(), "place": place_json(result.place)}
            return {"points": result.points, "matched": result.matched.astype(np.int32)}, content

        inputs = steps.inputs(scan, options, weights=weights, neutral=array_digest(neutral.points))
        inputs |= {
            "shapes": array_digest(*(shapes[shape] for shape in weights)),
            "markers": {name: np.asarray(place).tolist() for name, place in neutral.landmarks.markers.items()},
        }
        inputs |= {"shown": array_digest(neutral.shown), "place": place_json(neutral.place) if neutral.place else None}
        inputs |= {"keeps": ["points", "matched", "report", "place"]}
        name = f"{self._below}expressions/{scan.name}"
        result = steps.step(name, inputs, compute, EXPRESSION)
        points = np.asarray(result.arrays["points"], np.float64)
        composite = Composite(
            points=points if self._below else steps.after_correction(name, points),
            weights=weights,  # as asked for: what this person does more or less belongs into the shapes
            matched=result.arrays["matched"].astype(bool),
        )
        place = place_of(result.content["place"])
        return FittedExpression(composite=composite, place=place, report=result.content["report"])

    def split(
        self, neutral: FloatArray, shapes: Shapes, composites: Mapping[str, Composite]
    ) -> tuple[dict[str, FloatArray], Mapping[str, Any]]:
        """The actor's own shapes, and the report.

        :raises FacepipeError: what can't be split or written
        """
        options, steps = self._project.split_options, self._steps

        def compute() -> tuple[dict[str, Any], dict[str, Any]]:
            result = SplitExpressions(options=options)(self._template, neutral, shapes, composites)
            return shape_arrays(result.shapes), {"names": list(result.shapes), "report": result.report.to_dict()}

        inputs = {
            "template": steps.digest(self._project.template),
            "neutral": array_digest(neutral),
            "shapes": array_digest(*shapes.values()),
            "names": list(shapes),
            "composites": {name: array_digest(one.points, one.matched) for name, one in composites.items()},
            "weights": {name: dict(one.weights) for name, one in composites.items()},
            "options": asdict(options),
        }
        result = steps.step("shapes", inputs, compute, SHAPES)
        return shapes_of(result.arrays, result.content["names"]), result.content["report"]

    def corrected_shapes(self, neutral: FloatArray, shapes: Shapes) -> dict[str, FloatArray]:
        """A corrected shape is the mesh with the shape on it whole: ``corrections/shapes/jawOpen.usdc``."""
        corrected = {}
        for name, delta in shapes.items():
            points = self._steps.after_correction(f"shapes/{name}", neutral + delta)
            corrected[name] = points - neutral if f"shapes/{name}" in self._steps.corrected else delta
        return corrected


def _shown_weights(together: Mapping[str, float], alone: Mapping[str, float]) -> dict[str, float]:
    """Weights of the shapes that the neutral's scan shows besides: together they are fitted as one shape, of which
    `together` has how much, by what was found alone."""
    share = next(iter(together.values()), 1.0)
    return {shape: share * weight for shape, weight in alone.items()}


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
