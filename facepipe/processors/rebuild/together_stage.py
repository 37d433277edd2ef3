"""The stage of a rebuild that refines the neutral on all scans together."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.processors.rebuild.fit_together import FitTogether, PlacedExpression, TogetherFit
from facepipe.processors.rebuild.fitted import FittedExpression, FittedNeutral
from facepipe.processors.rebuild.kept_result import NEUTRAL
from facepipe.processors.rebuild.register_scans import ExpressionScan
from facepipe.processors.rebuild.stage_content import place_json, plain
from facepipe.processors.rebuild.stages import Stages
from facepipe.processors.rebuild.work_folder import StageResult, array_digest

Expressions = Mapping[str, FittedExpression]


def together_stage(
    stages: Stages, name: str, first: FittedNeutral, shapes: Mapping[str, FloatArray], expressions: Expressions
) -> StageResult:
    """The neutral refined on all scans, from fits to each alone.

    :param name: of the stage
    :param shapes: the personal template of `first`
    :raises FacepipeError: what can't be read, fitted or written
    """

    def compute() -> tuple[dict[str, Any], dict[str, Any]]:
        found = _fit(stages, first, shapes, expressions)
        together = {
            "moved_mean_mm": found.moved_mean_mm,
            "weights": dict(zip(expressions, found.weights, strict=True)),
        }
        report = plain(found.neutral.report)
        report |= {"weights": _shown_weights(report["weights"], first.report["weights"]), "together": together}
        arrays = {"points": found.neutral.points, "expression": found.neutral.expression}
        return arrays, {"report": report, "place": place_json(found.neutral.place)}

    return stages.stage(name, _inputs(stages, first, shapes, expressions), compute, NEUTRAL)


def _fit(
    stages: Stages, first: FittedNeutral, shapes: Mapping[str, FloatArray], expressions: Expressions
) -> TogetherFit:
    project, placed = stages.project, []
    scans = {scan.name: scan for scan in project.expressions}
    for name, one in expressions.items():
        scan, marks = stages.read(scans[name])
        given = ExpressionScan(scan=scan, landmarks=marks, weights=one.composite.weights)
        placed.append(PlacedExpression(expression=given, place=one.place))
    scan, marks = stages.read(project.neutral)
    fit = FitTogether(neutral=project.neutral_options, expressions=project.expression_options)
    neutral, coefficients = replace(first.scan, landmarks=marks), np.array(first.report["coefficients"])
    return fit(stages.template, scan, neutral, coefficients, stages.database(), shapes, placed)


def _shown_weights(found: Mapping[str, float], alone: Mapping[str, float]) -> dict[str, float]:
    """Weights of the shapes that the neutral's scan shows besides: together they are fitted as one shape, of which
    `found` has how much, by what was found alone."""
    share = next(iter(found.values()), 1.0)
    return {shape: share * weight for shape, weight in alone.items()}


def _inputs(
    stages: Stages, first: FittedNeutral, shapes: Mapping[str, FloatArray], expressions: Expressions
) -> dict[str, Any]:
    project = stages.project
    scans = {scan.name: scan for scan in project.expressions}
    inputs = stages.inputs(project.neutral, project.neutral_options, database=stages.digest(project.database))
    return inputs | {
        "first": array_digest(first.scan.points, first.scan.shown, np.array(first.report["coefficients"])),
        "weights": dict(first.report["weights"]),
        "place": place_json(first.place),
        "shapes": array_digest(*shapes.values()),
        "expressions": {
            name: stages.inputs(
                scans[name],
                project.expression_options,
                weights=dict(one.composite.weights),
                place=place_json(one.place),
            )
            for name, one in expressions.items()
        },
    }
