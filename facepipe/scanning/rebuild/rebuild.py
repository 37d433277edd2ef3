"""Rebuild: from a project's scans to the actor's neutral and shapes, step by step (document S13 to S16)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.declare import values_of
from facepipe.geometry.similarity import Similarity
from facepipe.importers import kind_of, load, obj
from facepipe.importers.scan_file import read_scan
from facepipe.importers.scan_landmarks import read_scan_landmarks
from facepipe.scanning.database import FaceDatabase, Quality, load_database, quality_from
from facepipe.scanning.rebuild.declared import RefineNeutralOptions
from facepipe.scanning.rebuild.fit_neutral import FitNeutralReport, NeutralScan, fit_neutral
from facepipe.scanning.rebuild.personal_template import starting_names, starting_shapes
from facepipe.scanning.rebuild.project import Project, ProjectScan, Refinement, expression_weights
from facepipe.scanning.rebuild.refine_neutral import RefineNeutralReport, refine_neutral
from facepipe.scanning.rebuild.register_scans import (
    Composite,
    ExpressionScan,
    RegisterScanReport,
    fit_together,
    register_scan,
)
from facepipe.scanning.rebuild.scan_check import ScanCheck, misfits, scan_checks
from facepipe.scanning.rebuild.scan_fit import landmarks_of
from facepipe.scanning.rebuild.split_expressions import SplitShapesReport, split_expressions, turned_over
from facepipe.scanning.rebuild.steps import (
    Arrays,
    Content,
    WorkFolder,
    array_digest,
    check_kept,
    place_json,
    place_of,
    shape_arrays,
    shapes_of,
)
from facepipe.scanning.rebuild.template import Template, region_weights
from facepipe.scans import Scan, ScanLandmarks
from facepipe.stage import open_face, save_parts
from facepipe.stage.recipes import source_digest
from facepipe.verbs.whole_faces import whole_face

Shapes = Mapping[str, FloatArray]  # name -> (n, 3) whole delta
Report = Mapping[str, Any]
Compute = Callable[[], tuple[Arrays, Content]]  # a step's result
# What was found, as corrected; from its scan's coordinates to those of its points; and how it lies there.
FittedNeutral = tuple[NeutralScan, Similarity, Report]
FittedExpression = tuple[Composite, Similarity, Report]

_ALONE = "alone/"  # folder of what a joint fit begins with
# What the steps keep.
_NEUTRAL = partial(check_kept, points=("points", "expression"), place=True, report=FitNeutralReport)
_REFINED = partial(check_kept, points=("points",), report=RefineNeutralReport)
_TEMPLATE = partial(check_kept, shapes=True)
_EXPRESSION = partial(check_kept, points=("points",), matched=True, place=True, report=RegisterScanReport)
_SHAPES = partial(check_kept, shapes=True, report=SplitShapesReport)


@dataclass(frozen=True, kw_only=True)
class Rebuilt:
    """An actor's face, and how it came about."""

    project: Project
    template: Template
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
    once = 2 + scans + bool(scans) + (project.options.refinement is not None)
    return once + (2 + scans) * is_joint(project)


def _neutral_arrays(neutral: NeutralScan) -> dict[str, FloatArray]:
    """What a step keeps of it: without shapes that the scan shows besides, their delta is 0."""
    shown = np.zeros_like(neutral.points) if neutral.expression is None else neutral.expression
    return {"points": neutral.points, "expression": shown}


class Rebuild:
    """One run of a project over its work folder: each fit from the results of those before it, which are kept there.

    Fits to each scan alone, which a joint fit begins with, are in a folder of their own; of expressions there no more
    than weights and places is used, and no correction.

    :param began: called with the name of each step as it begins
    :raises InputError: a work folder that can't be made
    """

    def __init__(
        self, project: Project, template: Template, began: Callable[[str], object] = lambda name: None
    ) -> None:
        self._project, self._template, self._began = project, template, began
        self._folder = WorkFolder(project.work)
        self._digests: dict[Path, str] = {}
        self._found: dict[Path, ScanLandmarks] = {}
        self._reused: list[str] = []
        self._corrected: list[str] = []
        self._checks: dict[str, ScanCheck] = {}
        self._left_out: dict[str, str] = {}

    def __call__(self) -> Rebuilt:
        """All steps.

        :raises FacepipeError: what can't be read, fitted or written; the results of the steps before stay
        """
        project, template, database = self._project, self._template, self._database
        options, scans = project.options, project.expressions
        # All regions and shapes that a project names are asked for before the first fit, as fits take minutes.
        if options.refinement is not None:
            region_weights(template.parts, options.refinement.regions, f"{project.path} -> options.refinement")
        names = starting_names(template, database, options.template)
        for scan in scans:
            expression_weights(project, scan, names)
        neutral = self._joint_neutral() if is_joint(project) else self._neutral()
        fits: dict[str, tuple[Any, Similarity, Report]] = {"neutral": neutral}
        if options.refinement is not None:
            neutral = fits["refined"] = self._refined(neutral, options.refinement)
        points = neutral[0].points
        start = shapes = self._starting_shapes(points)
        found = {scan.name: self._expression(scan, neutral[0], shapes) for scan in scans}
        fits |= {f"expressions/{name}": one for name, one in found.items()}
        reports = {name: report for name, (_, _, report) in fits.items()}
        composites = {name: one for name, (one, _, _) in self._belonging(points, shapes, found).items()}
        if composites:
            shapes, reports["shapes"] = self._split(points, shapes, composites)
        # A corrected shape is the mesh with the shape on it whole: ``corrections/shapes/jawOpen.usdc``.
        for name, delta in shapes.items():
            whole = self._after_correction(f"shapes/{name}", points + delta)
            if f"shapes/{name}" in self._corrected:
                shapes = {**shapes, name: whole - points}
        quality = quality_from(neutral[2]["quality"], "neutral")
        turned = turned_over(template, points, start, {n: one for n, one in shapes.items() if one is not start[n]})
        lines = [line for report in reports.values() for line in report.get("warnings", ())]
        if left := sorted({*template.parts.shapes} - shapes.keys()):
            lines.append(f"{template.where}: the database lacks {', '.join(left)}: the template's offsets are kept")
        idle = [name for name in self._folder.corrections() if name not in self._corrected]
        lines += [f"{self._folder.path}/corrections/{name}: corrects no result" for name in idle]
        return Rebuilt(
            project=project,
            template=template,
            neutral=points,
            shapes=shapes,
            reports=reports,
            personal=start,
            shown=neutral[0].shown,
            composites={name: composite.points for name, (composite, _, _) in found.items()},
            checks=self._checks,
            left_out=self._left_out,
            places={name: place for name, (_, place, _) in fits.items()},
            quality=replace(quality, flipped_triangles=quality.flipped_triangles + turned),
            reused=tuple(self._reused),
            corrected=tuple(self._corrected),
            warnings=tuple(lines),
        )

    def _neutral(self, below: str = "") -> FittedNeutral:
        """On its scan alone.

        :param below: folder of the results, ending in a slash
        """
        project = self._project

        def compute() -> tuple[Arrays, Content]:
            scan, marks = self._read(project.neutral)
            options, weights = project.options.neutral, project.neutral.weights
            fit, place, report = fit_neutral(self._template, scan, marks, self._database, options, weights=weights)
            return _neutral_arrays(fit), {"report": report.of_fit(), "place": place_json(place)}

        inputs = self._inputs(project.neutral, project.options.neutral, database=self._digest(project.database))
        inputs |= {"weights": dict(project.neutral.weights), "keeps": ["points", "expression", "report", "place"]}
        return self._fitted_neutral(f"{below}neutral", inputs, compute)

    def _joint_neutral(self) -> FittedNeutral:
        """On all scans together, which begins with fits to each; on its scan alone where no other belongs."""
        project, options = self._project, self._project.options
        scans = {scan.name: scan for scan in project.expressions}
        neutral, first_place, alone = self._neutral(_ALONE)
        shapes = self._starting_shapes(neutral.points, _ALONE)
        found = {name: self._expression(scan, neutral, shapes, _ALONE) for name, scan in scans.items()}
        expressions = self._belonging(neutral.points, shapes, found)
        if not expressions:
            return self._neutral()
        coefficients = np.array(alone["coefficients"])

        def compute() -> tuple[Arrays, Content]:
            placed = []
            for name, (composite, place, _) in expressions.items():
                raw, marks = self._read(scans[name])
                placed.append(ExpressionScan(scan=raw, landmarks=marks, weights=composite.weights, place=place))
            raw, marks = self._read(project.neutral)
            given, database = replace(neutral, landmarks=marks), self._database
            fit, own_report, others, moved_mm = fit_together(
                self._template, raw, given, coefficients, database, shapes, placed, options.neutral, options.expressions
            )
            weights = {
                name: dict(zip(one.weights, map(float, other.weights), strict=True))
                for name, one, other in zip(expressions, placed, others, strict=True)
            }
            report = own_report.of_fit()
            # Shapes that the neutral's scan shows besides are fitted as one, of which there is `share`, by what was
            # found alone.
            share = next(iter(report["weights"].values()), 1.0)
            report["weights"] = {shape: share * weight for shape, weight in alone["weights"].items()}
            report["together"] = {"moved_mean_mm": moved_mm, "weights": weights}
            return _neutral_arrays(fit), {"report": report, "place": place_json(fit.place)}

        inputs = self._inputs(project.neutral, options.neutral, database=self._digest(project.database))
        inputs |= {
            "first": array_digest(neutral.points, neutral.shown, coefficients),
            "weights": dict(alone["weights"]),
            "place": place_json(first_place),
            "shapes": array_digest(*shapes.values()),
        }
        inputs["expressions"] = {}
        for name, (composite, place, _) in expressions.items():
            given = {"weights": dict(composite.weights), "place": place_json(place)}
            inputs["expressions"][name] = self._inputs(scans[name], options.expressions, **given)
        return self._fitted_neutral("neutral", inputs, compute)

    def _fitted_neutral(self, name: str, inputs: Content, compute: Compute) -> FittedNeutral:
        arrays, content = self._step(name, inputs, compute, _NEUTRAL)
        given, place = self._project.neutral, place_of(content["place"])
        neutral = NeutralScan(
            points=self._after_correction(name, arrays["points"]),
            place=place,
            landmarks=read_scan_landmarks(given.landmarks, given.scan) if given.landmarks else ScanLandmarks(),
            expression=arrays["expression"] if given.weights else None,
        )
        return neutral, place, content["report"]

    def _refined(self, fitted: FittedNeutral, refinement: Refinement) -> FittedNeutral:
        """The neutral drawn closer to its scan, as corrected.

        :raises FacepipeError: an unknown region, or what can't be read, fitted or written
        """
        project, template, (neutral, place, report) = self._project, self._template, fitted
        weights = region_weights(template.parts, refinement.regions, f"{project.path} -> options.refinement")
        options = RefineNeutralOptions(**values_of(RefineNeutralOptions, refinement))  # regions apart, in the key too
        points, flipped = neutral.points, quality_from(report["quality"], "neutral").flipped_triangles

        def compute() -> tuple[Arrays, Content]:
            scan, marks = self._read(project.neutral)
            given = (template, points, scan, marks, place, weights, neutral.expression)
            refined, _, found = refine_neutral(*given, options=options, flipped=flipped)
            return {"points": refined}, {"report": found.of_fit()}

        inputs = self._inputs(project.neutral, options, neutral=array_digest(points, neutral.shown))
        inputs |= {"regions": list(refinement.regions), "place": place_json(place), "flipped": flipped}
        arrays, content = self._step("refined", inputs, compute, _REFINED)
        refined = replace(neutral, points=self._after_correction("refined", arrays["points"]))
        return refined, place, content["report"]

    def _starting_shapes(self, neutral: FloatArray, below: str = "") -> Shapes:
        """Those of `neutral` (n, 3)."""
        project = self._project
        options = project.options.template

        def compute() -> tuple[Arrays, Content]:
            shapes = starting_shapes(self._template, neutral, self._database, options)
            return shape_arrays(shapes), {"names": list(shapes)}

        inputs = {
            "neutral": array_digest(neutral),
            "template": self._digest(project.template),
            "database": self._digest(project.database),
            "options": asdict(options),
        }
        arrays, content = self._step(f"{below}template", inputs, compute, _TEMPLATE)
        return shapes_of(arrays, content["names"])

    def _expression(self, scan: ProjectScan, neutral: NeutralScan, shapes: Shapes, below: str = "") -> FittedExpression:
        """One expression from the neutral and its shapes."""
        options = self._project.options.expressions
        weights = expression_weights(self._project, scan, tuple(shapes))

        def compute() -> tuple[Arrays, Content]:
            raw, marks = self._read(scan)
            given = ExpressionScan(scan=raw, landmarks=marks, weights=weights)
            found, place, report = register_scan(self._template, neutral, shapes, given, options)
            kept = {"points": found.points, "matched": found.matched.astype(np.int32)}
            return kept, {"report": report.of_fit(), "place": place_json(place)}

        inputs = self._inputs(scan, options, weights=weights, neutral=array_digest(neutral.points))
        inputs |= {
            "shapes": array_digest(*(shapes[shape] for shape in weights)),
            "markers": {name: np.asarray(place).tolist() for name, place in neutral.landmarks.markers.items()},
            "shown": array_digest(neutral.shown),
            "place": place_json(neutral.place),
            "keeps": ["points", "matched", "report", "place"],
        }
        name = f"{below}expressions/{scan.name}"
        arrays, content = self._step(name, inputs, compute, _EXPRESSION)
        points = np.asarray(arrays["points"], np.float64)
        composite = Composite(
            points=points if below else self._after_correction(name, points),
            weights=weights,  # as asked for: what this person does more or less belongs into the shapes
            matched=arrays["matched"].astype(bool),
        )
        return composite, place_of(content["place"]), content["report"]

    def _belonging(
        self, neutral: FloatArray, shapes: Shapes, found: Mapping[str, FittedExpression]
    ) -> dict[str, FittedExpression]:
        """Those of the expressions whose scans belong to the actor, now and before, or that an artist has corrected."""
        composites = {name: composite for name, (composite, _, _) in found.items()}
        fits = {name: report["fit"] for name, (_, _, report) in found.items()}
        self._checks |= scan_checks(self._template, neutral, shapes, composites, fits)
        asked = {name: composite.weights for name, composite in composites.items()}
        self._left_out |= {
            name: reason
            for name, reason in misfits(self._checks, asked).items()
            if self._folder.correction(f"expressions/{name}") is None
        }
        return {name: one for name, one in found.items() if name not in self._left_out}

    def _split(self, neutral: FloatArray, shapes: Shapes, composites: Mapping[str, Composite]) -> tuple[Shapes, Report]:
        """The actor's own shapes, and the report."""
        options = self._project.options.split

        def compute() -> tuple[Arrays, Content]:
            found, report = split_expressions(self._template, neutral, shapes, composites, options)
            return shape_arrays(found), {"names": list(found), "report": report.of_fit()}

        inputs = {
            "template": self._digest(self._project.template),
            "neutral": array_digest(neutral),
            "shapes": array_digest(*shapes.values()),
            "names": list(shapes),
            "composites": {name: array_digest(one.points, one.matched) for name, one in composites.items()},
            "weights": {name: dict(one.weights) for name, one in composites.items()},
            "options": asdict(options),
        }
        arrays, content = self._step("shapes", inputs, compute, _SHAPES)
        return shapes_of(arrays, content["names"]), content["report"]

    def _step(self, name: str, inputs: Content, compute: Compute, check: Callable[..., None]) -> tuple[Arrays, Content]:
        """The result of a step, with a mesh beside it where it has points: for eyes and for an artist's hand."""
        self._began(name)
        topology = self._template.topology
        given = partial(check, count=topology.point_count)
        arrays, content, is_reused = self._folder.step(name, inputs, compute, given)
        if is_reused:
            self._reused.append(name)
        if "points" in arrays:
            path = self._folder.place(f"{name}.usdc")
            if not (is_reused and path.is_file()):
                save_parts(topology.parts(arrays["points"]), path)
        return arrays, content

    def _after_correction(self, name: str, points: FloatArray) -> FloatArray:
        """The points (n, 3) of a step, or of the mesh that an artist put in their place.

        :raises InputError: a mesh that can't be read, or more than one
        :raises TopologyError: a mesh of another topology
        """
        path = self._folder.correction(name)
        if path is None:
            return np.asarray(points, np.float64)
        self._corrected.append(name)
        if path.suffix == ".obj":  # in millimetres, Y up, as the meshes of the work folder are
            parts = load("obj", path, obj.Options(meters_per_unit=0.001, up_axis="Y")).parts
        elif path.suffix in (".glb", ".gltf", ".fbx"):
            parts = load(kind_of(path), path).parts
        else:
            parts = open_face(path).parts()
        return whole_face(parts, str(path), self._template.topology, self._template.where).points

    def _read(self, scan: ProjectScan) -> tuple[Scan, ScanLandmarks]:
        """A scan and its landmarks, which are found on it, once, where none are given."""
        named = replace(read_scan(scan.scan), name=str(scan.scan))
        if scan.landmarks:
            return named, read_scan_landmarks(scan.landmarks, named)
        if scan.scan not in self._found:
            self._found[scan.scan] = landmarks_of(None, named)[0]
        return named, self._found[scan.scan]

    @cached_property
    def _database(self) -> FaceDatabase:
        return load_database(self._project.database)

    def _digest(self, path: Path | None) -> str:
        """Of a file with what it stands on, found once; empty where there is none."""
        if path is None:
            return ""
        if path not in self._digests:
            self._digests[path] = source_digest(path)
        return self._digests[path]

    def _inputs(self, scan: ProjectScan, options: Any, **more: Any) -> dict[str, Any]:
        """What a fit to one scan depends on."""
        return {
            "template": self._digest(self._project.template),
            "scan": self._digest(scan.scan),
            "landmarks": self._digest(scan.landmarks),
            "options": asdict(options),
            **more,
        }
