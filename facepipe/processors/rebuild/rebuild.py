"""Rebuild: from a project's scans to the actor's neutral and shapes, stage by stage (document S13 to S16)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facepipe.geometry.flips import flipped_triangles
from facepipe.geometry.similarity import Similarity
from facepipe.parts import FaceParts
from facepipe.processors.database import FaceDatabase, Quality, load_database, quality_from, whole_face
from facepipe.processors.rebuild.composites import resolved
from facepipe.processors.rebuild.fit_neutral import FitNeutral
from facepipe.processors.rebuild.personal_template import PersonalTemplate
from facepipe.processors.rebuild.project import Project, ProjectScan
from facepipe.processors.rebuild.register_scans import Composite, ExpressionScan, NeutralScan, RegisterScans
from facepipe.processors.rebuild.split_expressions import SplitExpressions
from facepipe.processors.rebuild.stage_content import (
    options_json,
    place_json,
    place_of,
    plain,
    shape_arrays,
    shapes_of,
)
from facepipe.processors.rebuild.template import Template
from facepipe.processors.rebuild.work_folder import StageResult, WorkFolder, array_digest, file_digest
from facepipe.scans import Scan, ScanLandmarks
from facepipe.stage import save_parts

FloatArray = npt.NDArray[np.floating]


@dataclass(frozen=True, kw_only=True)
class Readers:
    """How files come in: the command binds them to the importers."""

    scan: Callable[[Path], Scan]
    landmarks: Callable[[Path], ScanLandmarks]
    find_landmarks: Callable[[Scan], ScanLandmarks]
    face: Callable[[Path], FaceParts]  # a corrected mesh


@dataclass(frozen=True, kw_only=True)
class Rebuilt:
    """An actor's face, and how it came about."""

    neutral: FloatArray  # (n, 3) whole points, millimetres
    shapes: Mapping[str, FloatArray]  # name -> (n, 3) whole delta
    reports: Mapping[str, Mapping[str, Any]]  # stage -> its report: "neutral", "expressions/NAME", "shapes"
    personal: Mapping[str, FloatArray]  # name -> (n, 3) whole delta of the personal template
    composites: Mapping[str, FloatArray]  # expression -> (n, 3) whole points
    places: Mapping[str, Similarity]  # stage of a scan -> from the scan's coordinates to those of the points
    quality: Quality  # of neutral and shapes, for a database
    reused: tuple[str, ...]  # stages whose results were there
    corrected: tuple[str, ...]  # results that a corrected mesh replaced
    warnings: tuple[str, ...]


class Rebuild:
    """One run of a project over its work folder.

    :param said: called with the name of each stage as it begins
    """

    def __init__(
        self, project: Project, template: Template, readers: Readers, said: Callable[[str], object] = lambda name: None
    ) -> None:
        self._project, self._template, self._readers, self._said = project, template, readers, said
        self._folder = WorkFolder(project.work)
        self._reused: list[str] = []
        self._corrected: list[str] = []
        self._database: FaceDatabase | None = None

    def __call__(self) -> Rebuilt:
        """All stages.

        :raises FacepipeError: what can't be read, fitted or written; the results of the stages before stay
        """
        project = self._project
        neutral, neutral_report, neutral_place = self._neutral()
        start = shapes = self._personal(neutral.points)
        found, reports, places = {}, {"neutral": neutral_report}, {"neutral": neutral_place}
        for scan in project.expressions:
            stage = f"expressions/{scan.name}"
            found[scan.name], reports[stage], places[stage] = self._expression(scan, neutral, shapes)
        if found:
            shapes, reports["shapes"] = self._split(neutral.points, shapes, found)
        shapes = self._corrected_shapes(neutral.points, shapes)
        lines = [line for report in reports.values() for line in report.get("warnings", ())]
        return Rebuilt(
            neutral=neutral.points,
            shapes=shapes,
            reports=reports,
            personal=start,
            composites={name: composite.points for name, composite in found.items()},
            places=places,
            quality=self._quality(neutral, neutral_report, start, shapes),
            reused=tuple(self._reused),
            corrected=tuple(self._corrected),
            warnings=(*lines, *self._left_shapes(shapes), *self._idle_corrections()),
        )

    def _neutral(self) -> tuple[NeutralScan, Mapping[str, Any], Similarity]:
        project = self._project
        landmarks: list[ScanLandmarks] = []

        def compute() -> tuple[dict[str, Any], dict[str, Any]]:
            scan, marks = self._read(project.neutral)
            landmarks.append(marks)
            fit = FitNeutral(options=project.neutral_options)(self._template, scan, marks, self._faces())
            content = {"report": plain(fit.report), "place": place_json(fit.place)}
            return {"points": fit.points}, content

        inputs = self._inputs(project.neutral, project.neutral_options, database=file_digest(project.database))
        found = self._stage("neutral", inputs, compute)
        points = self._after_correction("neutral", found.arrays["points"])
        marks = landmarks[0] if landmarks else self._landmarks(project.neutral)
        place = place_of(found.content["place"])
        return NeutralScan(points=points, place=place, landmarks=marks), found.content["report"], place

    def _personal(self, neutral: FloatArray) -> dict[str, FloatArray]:
        project = self._project

        def compute() -> tuple[dict[str, Any], dict[str, Any]]:
            make = PersonalTemplate(options=project.template_options)
            shapes = make(self._template, neutral, self._faces())
            return shape_arrays(shapes), {"names": list(shapes)}

        inputs = {
            "neutral": array_digest(neutral),
            "template": file_digest(project.template),
            "database": file_digest(project.database),
            "options": options_json(project.template_options),
        }
        found = self._stage("template", inputs, compute)
        return shapes_of(found.arrays, found.content["names"])

    def _expression(
        self, scan: ProjectScan, neutral: NeutralScan, shapes: Mapping[str, FloatArray]
    ) -> tuple[Composite, Mapping[str, Any], Similarity]:
        options = self._project.expression_options
        weights = resolved(scan.weights, tuple(shapes), f"{self._project.path} -> {scan.name} -> weights")

        def compute() -> tuple[dict[str, Any], dict[str, Any]]:
            one, marks = self._read(scan)
            given = ExpressionScan(scan=one, landmarks=marks, weights=weights)
            found = RegisterScans(options=options)(self._template, neutral, shapes, given)
            content = {"report": plain(found.report), "place": place_json(found.place)}
            return {"points": found.points, "matched": found.matched.astype(np.int32)}, content

        inputs = self._inputs(scan, options, weights=weights, neutral=array_digest(neutral.points))
        inputs |= {"shapes": array_digest(*(shapes[shape] for shape in weights)), "markers": _markers(neutral)}
        inputs |= {"keeps": ["points", "matched", "report", "place"]}
        name = f"expressions/{scan.name}"
        found = self._stage(name, inputs, compute)
        points = self._after_correction(name, found.arrays["points"])
        composite = Composite(
            points=points,
            weights=weights,  # as asked for: what this person does more or less belongs into the shapes
            matched=found.arrays["matched"].astype(bool),
        )
        return composite, found.content["report"], place_of(found.content["place"])

    def _split(
        self, neutral: FloatArray, shapes: Mapping[str, FloatArray], composites: Mapping[str, Composite]
    ) -> tuple[dict[str, FloatArray], Mapping[str, Any]]:
        options = self._project.split_options

        def compute() -> tuple[dict[str, Any], dict[str, Any]]:
            found = SplitExpressions(options=options)(self._template, neutral, shapes, composites)
            return shape_arrays(found.shapes), {"names": list(found.shapes), "report": plain(found.report)}

        inputs = {
            "neutral": array_digest(neutral),
            "shapes": array_digest(*shapes.values()),
            "names": list(shapes),
            "composites": {name: array_digest(one.points, one.matched) for name, one in composites.items()},
            "weights": {name: dict(one.weights) for name, one in composites.items()},
            "options": options_json(options),
        }
        found = self._stage("shapes", inputs, compute)
        return shapes_of(found.arrays, found.content["names"]), found.content["report"]

    def _corrected_shapes(self, neutral: FloatArray, shapes: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        """A corrected shape is the mesh with the shape on it whole: ``corrections/shapes/jawOpen.usdc``."""
        corrected = {}
        for name, delta in shapes.items():
            points = self._after_correction(f"shapes/{name}", neutral + delta)
            corrected[name] = delta if f"shapes/{name}" not in self._corrected else points - neutral
        return corrected

    def _stage(
        self, name: str, inputs: Mapping[str, Any], compute: Callable[[], tuple[dict[str, Any], dict[str, Any]]]
    ) -> StageResult:
        self._said(name)
        found = self._folder.stage(name, inputs, compute)
        if found.reused:
            self._reused.append(name)
        if "points" in found.arrays:
            self._show(name, found)
        return found

    def _show(self, name: str, found: StageResult) -> None:
        """A mesh beside the result, for eyes and for an artist's hand."""
        path = self._folder.path / f"{name}.usdc"
        if not (found.reused and path.is_file()):
            save_parts(self._template.topology.parts(found.arrays["points"]), path)

    def _after_correction(self, name: str, points: FloatArray) -> FloatArray:
        path = self._folder.correction(name)
        if path is None:
            return np.asarray(points, np.float64)
        self._corrected.append(name)
        return whole_face(self._readers.face(path), str(path), self._template.topology, self._template.where).points

    def _quality(
        self,
        neutral: NeutralScan,
        report: Mapping[str, Any],
        start: Mapping[str, FloatArray],
        shapes: Mapping[str, FloatArray],
    ) -> Quality:
        """The neutral's, and triangles that shapes turn where the personal template does not."""
        found, triangles = quality_from(report["quality"], "neutral"), self._template.topology.triangles
        turned = found.flipped_triangles
        for name, delta in shapes.items():
            if delta is not start[name]:
                before, after = neutral.points + start[name], neutral.points + delta
                turned += int(flipped_triangles(before, after, triangles).sum())
        return replace(found, flipped_triangles=turned)

    def _left_shapes(self, shapes: Mapping[str, FloatArray]) -> tuple[str, ...]:
        own = {shape.name for mesh in self._template.parts.meshes for shape in mesh.blendshapes}
        left = sorted(own - set(shapes))
        where = self._template.where
        return (f"{where}: the database lacks {', '.join(left)}: the template's offsets are kept",) if left else ()

    def _idle_corrections(self) -> tuple[str, ...]:
        idle = [name for name in self._folder.corrections() if name not in self._corrected]
        return tuple(f"{self._folder.path}/corrections/{name}: corrects no result" for name in idle)

    def _inputs(self, scan: ProjectScan, options: Any, **more: Any) -> dict[str, Any]:
        return {
            "template": file_digest(self._project.template),
            "scan": file_digest(scan.scan),
            "landmarks": file_digest(scan.landmarks),
            "options": options_json(options),
            **more,
        }

    def _read(self, scan: ProjectScan) -> tuple[Scan, ScanLandmarks]:
        one = replace(self._readers.scan(scan.scan), name=str(scan.scan))
        marks = self._landmarks(scan)
        return one, marks if scan.landmarks else self._readers.find_landmarks(one)

    def _landmarks(self, scan: ProjectScan) -> ScanLandmarks:
        return self._readers.landmarks(scan.landmarks) if scan.landmarks else ScanLandmarks()

    def _faces(self) -> FaceDatabase:
        if self._database is None:
            self._database = load_database(self._project.database)
        return self._database


def _markers(neutral: NeutralScan) -> dict[str, list[float]]:
    return {name: np.asarray(place).tolist() for name, place in neutral.landmarks.markers.items()}
