"""Actors of projects: rebuilt by `facepipe rebuild`, and again from their recipes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

from facepipe.core.atomic import apart
from facepipe.core.errors import SchemaError
from facepipe.core.reports import Report
from facepipe.importers.scan_file import read_scan
from facepipe.importers.scan_landmarks import read_scan_landmarks
from facepipe.kinds import Watch
from facepipe.parts import FaceParts
from facepipe.pipeline.verbs import Cooked
from facepipe.processors.database import QualityLimits, misses
from facepipe.processors.rebuild import Project, Readers, Rebuild, Rebuilt, Template, read_project
from facepipe.processors.rebuild.author_neutral import AuthorNeutral
from facepipe.processors.rebuild.rebuild import stage_count
from facepipe.processors.rebuild.rebuild_recipe import VERB, rebuild_recipe
from facepipe.scans import Scan, ScanLandmarks
from facepipe.stage import open_face
from facepipe.stage.recipes import existing_source, recipe_of


@dataclass(frozen=True, kw_only=True)
class RebuildReport(Report):
    """What a rebuild did."""

    stages: Mapping[str, Any] = field(default_factory=dict)  # stage -> its report
    quality: Mapping[str, Any] = field(default_factory=dict)  # how the neutral lies on its scan
    reused: tuple[str, ...] = ()  # stages whose results were there
    corrected: tuple[str, ...] = ()  # stages in whose place an artist put a mesh
    missed: tuple[str, ...] = ()  # a line for each limit


class Actor(NamedTuple):
    """A rebuild that is authored and not yet saved."""

    project: Project
    template: Template
    rebuilt: Rebuilt
    report: RebuildReport


def cook(path: Path, watch: Watch) -> Cooked:
    """Rebuild again in the place of the result at `path`; stages that are up to date in the work folder are reused.

    :raises FacepipeError: a recipe or sources that can't be read, or that can't be fitted
    """
    recipe, standalone = recipe_of(path, VERB)
    where = f"{path} -> recipe"
    name, joint = recipe.options.get("project"), recipe.options.get("joint")
    if name not in recipe.sources or not isinstance(joint, bool):
        raise SchemaError(where, "options are damaged, expected a project among the sources, and joint")
    project = read_project(existing_source(where, path.absolute().parent / str(name), "PROJECT"))
    report = make(replace(project, joint=project.joint or joint), path, watch, flatten=standalone)
    return Cooked(report=report, missed=bool(report.missed))


def make(
    project: Project,
    out: Path,
    watch: Watch,
    *,
    flatten: bool = False,
    seen: Callable[[Actor], object] = lambda actor: None,
) -> RebuildReport:
    """Read, rebuild, author, save.

    :param seen: called with the result before it is saved
    :raises FacepipeError: what can't be read, fitted or written
    """
    face = open_face(project.template)
    template = Template.of(face.parts(), str(project.template))
    with watch("rebuild", stage_count(project)) as bar, apart():  # stages stay where a later one fails
        rebuilt = Rebuild(project, template, _readers(), lambda name: _said(bar, name))()
    recipe, missed = rebuild_recipe(project, out, rebuilt.quality), misses(rebuilt.quality, QualityLimits())
    with face.deriving(out, flatten=flatten) as derived:
        authored = AuthorNeutral(shapes=rebuilt.shapes)(derived, rebuilt.neutral, recipe=recipe)
        report = RebuildReport(
            stages=rebuilt.reports,
            quality=dataclasses.asdict(rebuilt.quality),
            reused=tuple(rebuilt.reused),
            corrected=tuple(rebuilt.corrected),
            missed=missed,
            warnings=(*rebuilt.warnings, *authored.warnings, *missed),
        )
        seen(Actor(project, template, rebuilt, report))
    return report


def _said(bar: Any, name: str) -> None:
    """Count a stage as it begins, and show its name where the bar can."""
    if hasattr(bar, "set_postfix_str"):
        bar.set_postfix_str(name)
    bar.update()


def _readers() -> Readers:
    return Readers(scan=read_scan, landmarks=read_scan_landmarks, find_landmarks=_found, face=_face)


def _found(scan: Scan) -> ScanLandmarks:
    from facepipe.pictures.surface_view import draw_surface
    from facepipe.processors.scan_landmarks import FindScanLandmarks

    return FindScanLandmarks(draw=draw_surface)(scan).landmarks


def _face(path: Path) -> FaceParts:
    """A corrected mesh; OBJ files are in millimetres, Y up, as the meshes of the work folder are."""
    from facepipe.importers import load, obj

    suffix = path.suffix.lower()
    if suffix == ".obj":
        return load("obj", path, obj.Options(meters_per_unit=0.001, up_axis="Y")).parts
    if suffix in (".glb", ".gltf"):
        return load("gltf", path).parts
    return open_face(path).parts()
