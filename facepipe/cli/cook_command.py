"""Make results anew whose sources have changed, from the recipes in them.

facepipe writes a recipe on each result: the files that went in, their digests, and all options. From each STAGE cook
follows its layers and the sources of recipes, and goes through the files with recipes in order of their dependencies.
A file whose sources have changed, or whose layers are missing, is made anew, to the same bytes that its command writes;
the others are left alone. Where a file comes out as it was, what depends on it stays up to date. Cook may be killed at
any moment and run again.

Edits made by hand in a result are lost when it is cooked. Put yours into a layer above it, which cook never writes: it
writes only files with recipes.

Files are written only below the roots of the STAGE that led to them: its folder, the nearest folder around it with a
facepipe.toml, or what --root gives. Other results that are stale are listed as `outside the roots`, and used as they
are.

Exit code 1: done, but a threshold was missed, results outside the roots are stale, --dry-run found something to cook,
or --validate found errors.

examples:
  facepipe cook shot.usda
  facepipe cook shot.usda --dry-run --json
  facepipe cook characters/*.usda --validate
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.cli.parser import add_options, options_from
from facepipe.cli.show import emit, progress, warn
from facepipe.core.errors import FacepipeError

if TYPE_CHECKING:
    from facepipe.cooking import NodeReport


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments."""
    from facepipe.cooking.report import CookOptions

    parser.add_argument(
        "stages", nargs="+", type=Path, metavar="STAGE", help="face stage, or a stage with faces among its layers"
    )
    add_options(parser, CookOptions)
    parser.add_argument("--json", action="store_true", help="print the report as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Cook, with a line for each file once it is done."""
    from facepipe.cooking import CookOptions, CookReport, cook
    from facepipe.cooking.cooking import shown

    done: list[NodeReport] = []

    def report_node(node: NodeReport) -> None:
        done.append(node)
        warn(node.warnings)
        if not arguments.json:
            why = f" ({'; '.join(node.why)})" if node.why else ""
            seconds = f" in {node.seconds:.1f} s" if node.action == "cooked" else ""
            missed = ", a threshold is missed" if node.missed else ""
            print(f"{shown(node.file)}: {node.verb}: {node.action}{seconds}{missed}{why}", flush=True)

    try:
        report = cook(arguments.stages, options_from(arguments, CookOptions), watch=progress, on_node=report_node)
    except FacepipeError as error:
        if arguments.json:  # the files before it are done
            so_far = CookReport(nodes=tuple(done), findings={}, seconds=sum(one.seconds for one in done))
            emit({**so_far.to_dict(), "good": False, "error": str(error)}, "", as_json=True)
        raise
    result = {"good": report.good, **report.to_dict()}
    findings = [str(finding) for findings in report.findings.values() for finding in findings]
    counts = {action: sum(node.action == action for node in report.nodes) for action in _ACTIONS}
    counted = [f"{count} {'to be cooked' if name == 'stale' else name}" for name, count in counts.items() if count]
    listed = ", ".join(counted)
    emit(
        result,
        "\n".join([*findings, f"{len(report.nodes)} file(s) with recipes{f': {listed}' if listed else ''}"]),
        as_json=arguments.json,
    )
    return 0 if report.good else 1


_ACTIONS = ("cooked", "stale", "outside the roots", "up to date")
