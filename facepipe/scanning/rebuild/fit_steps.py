"""The fits of a rebuild as steps: neutral, its refinement, personal template, expressions, shapes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.scanning.database import quality_from
from facepipe.scanning.rebuild.fit_neutral import FitNeutral
from facepipe.scanning.rebuild.fit_together import FitTogether, PlacedExpression
from facepipe.scanning.rebuild.personal_template import PersonalTemplate
from facepipe.scanning.rebuild.project import ProjectScan, Refinement, expression_weights
from facepipe.scanning.rebuild.refine_neutral import RefineNeutral
from facepipe.scanning.rebuild.register_scans import Composite, ExpressionScan, NeutralScan, RegisterScans
from facepipe.scanning.rebuild.split_expressions import SplitExpressions
from facepipe.scanning.rebuild.step_results import (
    EXPRESSION,
    NEUTRAL,
    REFINED,
    SHAPES,
    TEMPLATE,
    FittedExpression,
    FittedNeutral,
    place_json,
    place_of,
    shape_arrays,
    shapes_of,
)
from facepipe.scanning.rebuild.steps import StepResult, Steps, array_digest
from facepipe.scanning.rebuild.template import region_weights

Shapes = Mapping[str, FloatArray]
Expressions = Mapping[str, FittedExpression]


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
        inputs |= {"shapes": array_digest(*(shapes[shape] for shape in weights)), "markers": _markers(neutral)}
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


def _markers(neutral: NeutralScan) -> dict[str, list[float]]:
    return {name: np.asarray(place).tolist() for name, place in neutral.landmarks.markers.items()}


def _shown_weights(together: Mapping[str, float], alone: Mapping[str, float]) -> dict[str, float]:
    """Weights of the shapes that the neutral's scan shows besides: together they are fitted as one shape, of which
    `together` has how much, by what was found alone."""
    share = next(iter(together.values()), 1.0)
    return {shape: share * weight for shape, weight in alone.items()}
