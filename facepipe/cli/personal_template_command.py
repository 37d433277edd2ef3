"""Make a person's starting shapes: those of a database or of the template, carried to the person's neutral.

NEUTRAL is a face stage of `facepipe fit-neutral`, corrected by hand or not, on the topology of --template. Shapes come
from --database, as its mean person has them and its people have in common, where it has expressions; else from the
template, by deformation transfer. OUT is an override layer over NEUTRAL; shapes that the database lacks stay as they
are. --flatten writes a standalone file.

examples:
  facepipe personal-template anna.usda --template head.usda --database faces.fpdb -o personal.usda
  facepipe personal-template anna.usda --template head.usda --shapes-from template -o personal.usda
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.cli.parser import add_options, add_output, options_from, output_of
from facepipe.cli.show import emit, progress, warn
from facepipe.core.texts import table

if TYPE_CHECKING:
    from facepipe.processors.rebuild.author_personal import PersonalReport


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments."""
    from facepipe.processors.rebuild import PersonalTemplateOptions

    add = parser.add_argument
    add("neutral", type=Path, metavar="NEUTRAL", help="face stage with the person's neutral")
    add("--template", type=Path, required=True, metavar="FACE", help="face stage that NEUTRAL was fitted with")
    add("--database", type=Path, metavar="FPDB", help="faces of the template's topology: .fpdb")
    add_output(parser, "override layer to write: .usda .usdc .usd .usdz")
    add("--flatten", action="store_true", help="write a standalone file")
    add("--json", action="store_true", help="print the report as JSON")
    add_options(parser, PersonalTemplateOptions)


def run(arguments: argparse.Namespace) -> int:
    """Read, carry over, author, report."""
    from facepipe.pipeline.personal_template import PersonalJob, make
    from facepipe.processors.rebuild import PersonalTemplateOptions

    inputs = [arguments.neutral, arguments.template, *([arguments.database] if arguments.database else [])]
    out = output_of(arguments, inputs)
    job = PersonalJob(
        neutral=arguments.neutral,
        template=arguments.template,
        database=arguments.database,
        out=out,
        options=options_from(arguments, PersonalTemplateOptions),
        flatten=arguments.flatten,
    )
    report = make(job, progress)
    warn(report.warnings)
    result = {"path": str(out), **json.loads(report.to_json())}
    emit(result, _text(out, report), as_json=arguments.json)
    return 0


def _text(out: Path, report: PersonalReport) -> str:
    rows = [
        ("shapes", f"{len(report.motion_mm)}, {report.source}"),
        ("largest motion", f"{max(report.motion_mm.values()):.1f} mm"),
        ("from the template's", f"mean {report.change_mean_mm:.2f} mm, over what they move"),
    ]
    return "\n".join([str(out), table(rows)])
