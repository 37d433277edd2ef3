"""Rebuild an actor's face from scans: the neutral, and the actor's own blendshapes, on a template's topology.

PROJECT (TOML) names the template, a face database, the scan of the neutral and those of other expressions, with the
shapes that each shows:

  template = "head.usda"
  database = "faces.fpdb"
  [neutral]
  scan = "scans/neutral.ply"                # landmarks: scans/neutral.landmarks.json, or found on the scan
  [expressions.smile]                       # its weights are in the table of composites
  scan = "scans/smile.ply"
  [expressions.wink]
  scan = "scans/wink.ply"
  weights = { eyeBlink_L = 1, cheekSquint_L = 0.5 }

[options.refinement] with regions = ["nose", ...] draws the neutral, or these regions of it, closer to its scan.

Each stage's result is kept in the project's work folder and used again until its inputs change: neutral, refined,
template, expressions/NAME, shapes. Beside it lies the mesh (NAME.usdc); a corrected one, saved as
corrections/NAME.usdc (.obj, .glb ...) in the work folder, takes its place in all that follows, and
corrections/shapes/jawOpen.usdc that of a shape.

With --joint the neutral is refined on all scans together, from fits to each alone (alone/ in the work folder): truer,
in about twice the time.

OUT is an override layer over the template. --report makes a folder of pictures: each scan beside what was registered to
it, and how much the scans told of each shape. Exit code 1: done, but a limit of the quality gate of `facepipe database
add` is missed.

examples:
  facepipe rebuild anna.toml -o anna.usda --report anna_report
  facepipe rebuild anna.toml -o anna.usda --joint --flatten --force --json
"""

from __future__ import annotations

import argparse
import json
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facepipe.cli.parser import add_output, output_of
from facepipe.cli.rebuild_report import RebuildPictures, check_folder, refined_line
from facepipe.cli.show import emit, progress, warn
from facepipe.core.atomic import replacing_folder, together
from facepipe.core.texts import table

if TYPE_CHECKING:
    from facepipe.pipeline.rebuild import Actor, RebuildReport
    from facepipe.processors.rebuild import Project


_SHOWN = 10  # shapes that the text names


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments."""
    add = parser.add_argument
    add("project", type=Path, metavar="PROJECT", help="scans, template, database and options: .toml")
    add_output(parser, "override layer to write: .usda .usdc .usd .usdz")
    add("--flatten", action="store_true", help="write a standalone file")
    add("--joint", action="store_true", help="refine the neutral on all scans together, as joint = true in PROJECT")
    add("--report", type=Path, metavar="DIR", help="folder to make: report, pictures of scans and shapes")
    add("--json", action="store_true", help="print the report as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Read, rebuild, author, report."""
    from facepipe.processors.rebuild import read_project
    from facepipe.processors.rebuild.work_folder import CORRECTIONS

    project = read_project(arguments.project)
    project = replace(project, joint=project.joint or arguments.joint)
    out = output_of(arguments, _inputs(project))
    if arguments.report is not None:
        taken = [*_inputs(project), out, project.work, project.work / CORRECTIONS]
        check_folder(arguments.report, force=arguments.force, taken=taken)
    report, result = _make(project, out, arguments)
    warn(report.warnings)
    emit(result, _text(out, report, arguments.report), as_json=arguments.json)
    return 1 if report.missed else 0


def _make(project: Project, out: Path, arguments: argparse.Namespace) -> tuple[RebuildReport, dict[str, Any]]:
    """Write the stage and its report, or none of them; what to print as JSON."""
    from facepipe.pipeline.rebuild import make

    def result(report: RebuildReport) -> dict[str, Any]:
        found = {"path": str(out), **json.loads(report.to_json())}
        return found if arguments.report is None else {**found, "report": str(arguments.report)}

    with together(out), ExitStack() as files:
        folder = None if arguments.report is None else files.enter_context(replacing_folder(arguments.report))

        def seen(actor: Actor) -> None:
            if folder is not None:
                pictures = RebuildPictures(project=project, template=actor.template, rebuilt=actor.rebuilt)
                _draw(folder, pictures, result(actor.report))

        report = make(project, out, progress, flatten=arguments.flatten, seen=seen)
    return report, result(report)


def _draw(folder: Path, pictures: RebuildPictures, result: dict[str, Any]) -> None:
    with progress("report", pictures.count) as bar:
        pictures.write(folder, result, bar.update)


def _inputs(project: Project) -> list[Path]:
    files = [project.path, project.template, project.database]
    for scan in (project.neutral, *project.expressions):
        files += [scan.scan, *([scan.landmarks] if scan.landmarks else [])]
    return files


def _text(out: Path, report: RebuildReport, report_folder: Path | None) -> str:
    rows: list[tuple[str, ...]] = [("scan", "mean mm", "p95 mm", "face seen", "landmarks mm")]
    for name, stage in report.stages.items():
        if "fit" in stage:
            fit = stage["fit"]
            numbers = (
                f"{fit['surface_mean_mm']:.3f}",
                f"{fit['surface_p95_mm']:.3f}",
                f"{100 * fit['coverage']:.0f} %",
            )
            rows.append((name.removeprefix("expressions/"), *numbers, f"{fit['landmark_mean_mm']:.2f}"))
    lines = [str(out), table(rows)]
    if "refined" in report.stages:
        lines.append(refined_line(report.stages["refined"]))
    if "shapes" in report.stages:
        shapes, unseen = report.stages["shapes"]["shapes"], report.stages["shapes"]["unseen"]
        lines.append(
            f"{len(shapes) - len(unseen)} of {len(shapes)} shapes told by the scans, the others the template's"
        )
        told = sorted(set(shapes) - set(unseen), key=lambda name: (-shapes[name]["change_mm"], name))[:_SHOWN]
        heads: tuple[str, ...] = ("changed most", "observed", "gain", "change mm", "scans")
        body = [
            (name, f"{one['observed']:.2f}", f"{one['gain']:.2f}", f"{one['change_mm']:.2f}", " ".join(one["scans"]))
            for name, one in ((name, shapes[name]) for name in told)
        ]
        lines += [table([heads, *body])] if body else []
    if report.reused:
        lines.append(f"reused: {', '.join(report.reused)}")
    if report.corrected:
        lines.append(f"corrected by hand: {', '.join(report.corrected)}")
    if report_folder is not None:
        lines.append(str(report_folder))
    return "\n".join(lines)
