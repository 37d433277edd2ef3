"""Stages over a work folder: what is read for them, what is kept of them, and what an artist put in their place."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.parts import FaceParts
from facepipe.processors.database import FaceDatabase, load_database, whole_face
from facepipe.processors.rebuild.kept_result import Kept
from facepipe.processors.rebuild.project import Project, ProjectScan
from facepipe.processors.rebuild.stage_content import options_json
from facepipe.processors.rebuild.template import Template
from facepipe.processors.rebuild.work_folder import StageResult, WorkFolder
from facepipe.scans import Scan, ScanLandmarks
from facepipe.stage import save_parts
from facepipe.stage.recipes import source_digest


@dataclass(frozen=True, kw_only=True)
class Readers:
    """How files come in: the command binds them to the importers."""

    scan: Callable[[Path], Scan]
    landmarks: Callable[[Path], ScanLandmarks]
    find_landmarks: Callable[[Scan], ScanLandmarks]
    face: Callable[[Path], FaceParts]  # a corrected mesh


class Stages:
    """The work folder of one run, and what happened in it.

    :param said: called with the name of each stage as it begins
    :raises InputError: a work folder that can't be made
    """

    def __init__(
        self, project: Project, template: Template, readers: Readers, said: Callable[[str], object] = lambda name: None
    ) -> None:
        self.project, self.template = project, template
        self._readers, self._said = readers, said
        self._folder = WorkFolder(project.work)
        self._database: FaceDatabase | None = None
        self._digests: dict[Path, str] = {}
        self._found: dict[Path, ScanLandmarks] = {}
        self.reused: list[str] = []
        self.corrected: list[str] = []

    def stage(
        self,
        name: str,
        inputs: Mapping[str, Any],
        compute: Callable[[], tuple[dict[str, Any], dict[str, Any]]],
        kept: Kept,
    ) -> StageResult:
        """The result of a stage, with a mesh beside it where it has points: for eyes and for an artist's hand.

        :raises FacepipeError: of `compute`
        """
        self._said(name)
        count = self.template.topology.point_count
        found = self._folder.stage(name, inputs, compute, partial(kept.check, count=count))
        if found.reused:
            self.reused.append(name)
        if "points" in found.arrays:
            self._show(name, found)
        return found

    def after_correction(self, name: str, points: FloatArray) -> FloatArray:
        """The points (n, 3) of a stage, or of the mesh that an artist put in their place.

        :raises InputError: a mesh that can't be read, or more than one
        :raises TopologyError: a mesh of another topology
        """
        path = self._folder.correction(name)
        if path is None:
            return np.asarray(points, np.float64)
        self.corrected.append(name)
        return whole_face(self._readers.face(path), str(path), self.template.topology, self.template.where).points

    def idle_corrections(self) -> tuple[str, ...]:
        """A line for each mesh that corrects nothing."""
        idle = [name for name in self._folder.corrections() if name not in self.corrected]
        return tuple(f"{self._folder.path}/corrections/{name}: corrects no result" for name in idle)

    def read(self, scan: ProjectScan) -> tuple[Scan, ScanLandmarks]:
        """A scan and its landmarks, which are found on it, once, where none are given.

        :raises FacepipeError: of the readers
        """
        one = replace(self._readers.scan(scan.scan), name=str(scan.scan))
        if scan.landmarks:
            return one, self.landmarks(scan)
        if scan.scan not in self._found:
            self._found[scan.scan] = self._readers.find_landmarks(one)
        return one, self._found[scan.scan]

    def landmarks(self, scan: ProjectScan) -> ScanLandmarks:
        """Those that are given for a scan."""
        return self._readers.landmarks(scan.landmarks) if scan.landmarks else ScanLandmarks()

    def database(self) -> FaceDatabase:
        """The project's, read once."""
        if self._database is None:
            self._database = load_database(self.project.database)
        return self._database

    def digest(self, path: Path | None) -> str:
        """Of a file with what it stands on, found once; empty where there is none.

        :raises InputError: a file that can't be read
        """
        if path is None:
            return ""
        if path not in self._digests:
            self._digests[path] = source_digest(path)
        return self._digests[path]

    def inputs(self, scan: ProjectScan, options: Any, **more: Any) -> dict[str, Any]:
        """What a fit to one scan depends on."""
        return {
            "template": self.digest(self.project.template),
            "scan": self.digest(scan.scan),
            "landmarks": self.digest(scan.landmarks),
            "options": options_json(options),
            **more,
        }

    def _show(self, name: str, found: StageResult) -> None:
        path = self._folder.place(f"{name}.usdc")
        if not (found.reused and path.is_file()):
            save_parts(self.template.topology.parts(found.arrays["points"]), path)
