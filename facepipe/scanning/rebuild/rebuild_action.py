"""Rebuild an actor's face from scans: the neutral, and the actor's own blendshapes, on a template's topology.

PROJECT (TOML) names the template, a face database, the scan of the neutral and those of other expressions, with the
shapes that each shows:

  template = "head.usdc"
  database = "faces.fpdb"
  [neutral]
  scan = "scans/neutral.ply"                # landmarks: scans/neutral.landmarks.json, or found on the scan
  [expressions.smile]                       # its weights are in the table of composites
  scan = "scans/smile.ply"
  [expressions.wink]
  scan = "scans/wink.ply"
  weights = { eyeBlink_L = 1, cheekSquint_L = 0.5 }

[options.refinement] with regions = ["nose", ...] draws the neutral, or these regions of it, closer to its scan.

Each step's result is kept in the project's work folder and used again until its inputs change: neutral, refined,
template, expressions/NAME, shapes. Beside it lies the mesh (NAME.usdc); a corrected one, saved as
corrections/NAME.usdc (.obj, .glb ...) in the work folder, takes its place in all that follows, and
corrections/shapes/jawOpen.usdc that of a shape.

With --joint the neutral is refined on all scans together, from fits to each alone (alone/ in the work folder): truer,
in about twice the time.

OUT is an override layer over the template. --report makes a folder of pictures: each scan beside what was registered to
it, and how much of each shape the scans show. A scan that does not belong, of another person or another expression, is
named and left out; one whose mesh lies in corrections/ never is. Exit code 1: done, but a scan was left out, or a limit
of the quality gate of `facepipe database add` is missed.

examples:
  facepipe rebuild anna.toml -o anna.usdc --report anna_report
  facepipe rebuild anna.toml -o anna.usdc --joint --flatten --force --json
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facepipe.core.errors import InputError
from facepipe.declare import beside, option, source, to_json
from facepipe.kinds import Job, StageAction, action

if TYPE_CHECKING:
    from facepipe.scanning.rebuild.project import Project
    from facepipe.scanning.rebuild.rebuild_report import RebuildReport
    from facepipe.stage import Face

_log = logging.getLogger(__name__)
_NAMES = r"report\.(html|json)|neutral\.png|expressions(/\w+\.png)?"


@action("rebuild", "make an actor's neutral and own shapes from scans")
@dataclass(frozen=True, kw_only=True)
class RebuildAction(StageAction["RebuildReport"]):
    """The action; what it finds on the way stays in the project's work folder."""

    project: Path = source("scans, template, database and options: .toml")
    joint: bool = option(False, "refine the neutral on all scans together, as joint = true in PROJECT")
    report: Path | None = beside("folder to make: report, pictures of scans and shapes", "", "draw", holds=_NAMES)

    @cached_property
    def _project(self) -> Project:
        from facepipe.scanning.rebuild.project import read_project

        project = read_project(Path(self.project))
        return replace(project, joint=project.joint or self.joint)

    @property
    def base(self) -> Path:
        return self._project.template

    @property
    def further_files(self) -> tuple[Path, ...]:
        project = self._project
        scans = (project.neutral, *project.expressions)
        each = (file for scan in scans for file in (scan.scan, scan.landmarks) if file is not None)
        return (project.template, project.database, *each)

    def check(self) -> None:
        from facepipe.scanning.rebuild.steps import CORRECTIONS

        super().check()
        folder = None if self.report is None else Path(self.report).resolve()
        for used in (self._project.work, self._project.work / CORRECTIONS):
            if folder is not None and (folder == used.resolve() or folder in used.resolve().parents):
                what = f"holds {used.name}, which is read or written too, expected another folder"
                raise InputError(str(self.report), what)

    def author(self, face: Face, job: Job) -> RebuildReport:
        from facepipe.core.atomic import apart
        from facepipe.heads.assembly import settled
        from facepipe.importers.scan_file import read_scan
        from facepipe.scanning.database import QualityLimits, load_database, misses
        from facepipe.scanning.rebuild.built_in_head import (
            bare_head,
            mouth_contacts,
            mouth_lines,
            with_inside_fitted,
        )
        from facepipe.scanning.rebuild.rebuild import Rebuild, step_count
        from facepipe.scanning.rebuild.rebuild_report import RebuildReport
        from facepipe.scanning.rebuild.scan_check import left_out_lines
        from facepipe.scanning.rebuild.template import Template
        from facepipe.scanning.texture import author_scan_textures
        from facepipe.verbs.author_neutral import AuthorNeutral
        from facepipe.verbs.whole_faces import whole_face

        parts, project = face.parts(), self._project
        template = Template.of(parts, str(self.base))
        body = template.body(load_database(project.database).topology)
        steps = step_count(project)
        with job.watch("rebuild", steps) as bar, apart():  # steps stay where a later one fails
            rebuilt = Rebuild(project, body, _named_steps(bar, steps))()
        quality = to_json(rebuilt.quality)
        missed = (*left_out_lines(project, rebuilt.left_out), *misses(rebuilt.quality, QualityLimits()))
        neutral, author = rebuilt.neutral, AuthorNeutral(shapes=template.dressed_shapes(body, rebuilt.shapes))
        if bare_head(parts) is not None:
            neutral = neutral if rebuilt.corrected else with_inside_fitted(neutral)
            found = rebuilt.reports.get("shapes", {}).get("shapes", {})
            observed = frozenset(name for name, shape in found.items() if shape["observed"] > 0)
            author = replace(author, settled=partial(settled, parts, observed=observed))
        authored = author(face, template.dressed(body, neutral), recipe=job.recipe(quality=quality))
        scan, shown = read_scan(project.neutral.scan), template.dressed(body, rebuilt.shown)
        place = rebuilt.places.get("refined", rebuilt.places["neutral"])
        baked = author_scan_textures(face, parts, shown, scan, place, project.options.textures)
        contacts = mouth_contacts(body, rebuilt.neutral, rebuilt.shapes, whole_face(body.parts, body.where).deltas)
        return RebuildReport(
            stages=rebuilt.reports,
            quality=quality,
            reused=rebuilt.reused,
            corrected=rebuilt.corrected,
            checks={name: asdict(check) for name, check in rebuilt.checks.items()},
            left_out=rebuilt.left_out,
            mouth=contacts,
            missed=missed,
            warnings=(*rebuilt.warnings, *authored.warnings, *baked.warnings, *mouth_lines(contacts), *missed),
            textures=baked.textures,
            colored=baked.colored,
            rebuilt=rebuilt,
            job=job,
        )

    def draw(self, face: Face, report: RebuildReport, path: Path) -> None:
        """The folder of the report, with what `--json` prints."""
        from facepipe.scanning.rebuild.rebuild_report import report_steps, write_report

        if report.rebuilt is not None and report.job is not None:
            result = {"path": str(report.job.out), **report.to_dict(), "report": str(self.report)}
            with report.job.watch("report", report_steps(report.rebuilt)) as bar:
                write_report(report.rebuilt, path, result, bar.update)


def _named_steps(bar: Any, steps: int) -> Callable[[str], None]:
    """Count steps as they begin, with their names where the bar can show them, and in logs."""
    numbers = count(1)

    def began(name: str) -> None:
        _log.info("rebuild: step %d of %d: %s", next(numbers), steps, name)
        if hasattr(bar, "set_postfix_str"):
            bar.set_postfix_str(name)
        bar.update()

    return began
