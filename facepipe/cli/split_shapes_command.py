"""Split registered expressions into the person's own shapes.

EXPRESSIONs are what `facepipe register-scan` made over --personal, as they are or with the shape corrected by hand.
Each is a sum of the shapes that its recipe names; together they tell how this person's shapes differ from the personal
template's. Shapes that no scan shows stay as they are.

OUT is an override layer over --personal. --flatten writes a standalone file. The table tells of each shape that scans
show: how much of it they decided (the rest being the template's), its motion along the template's (1: as much), how
far it is from the template's, and which scans show it. Exit code 1: done, but what the shapes leave of an expression
is over 2 mm at more than one point in twenty.

examples:
  facepipe split-shapes work/smile.usda work/anger.usda --personal personal.usda -o actor.usda
  facepipe split-shapes work/*.usda --personal personal.usda -o actor.usda --flatten --json
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.cli.parser import add_options, add_output, options_from, output_of
from facepipe.cli.scan_input import named
from facepipe.cli.show import emit, table, warn

if TYPE_CHECKING:
    from facepipe.processors.rebuild import SplitReport

_MOST_LEFT_MM = 2.0  # 95th percentile of what shapes leave of an expression


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments."""
    from facepipe.processors.rebuild import SplitExpressionsOptions

    add = parser.add_argument
    add("expressions", nargs="+", type=Path, metavar="EXPRESSION", help="what `facepipe register-scan` made")
    add("--personal", type=Path, required=True, metavar="FACE", help="what they were registered with")
    add_output(parser, "override layer to write: .usda .usdc .usd .usdz")
    add("--flatten", action="store_true", help="write a standalone file")
    add("--json", action="store_true", help="print the report as JSON")
    add_options(parser, SplitExpressionsOptions, "how to split")


def run(arguments: argparse.Namespace) -> int:
    """Read, split, author, report."""
    from facepipe.processors.database import whole_face
    from facepipe.processors.rebuild import SplitExpressions, SplitExpressionsOptions, Template
    from facepipe.processors.rebuild.author_split import SplitFiles, author_shapes
    from facepipe.processors.rebuild.expression_file import read_expression
    from facepipe.stage import open_face

    personal: Path = arguments.personal
    out = output_of(arguments, [personal, *arguments.expressions])
    split = SplitFiles(split=SplitExpressions(options=options_from(arguments, SplitExpressionsOptions)))
    face = open_face(personal)
    parts = face.parts()
    template, base = Template.of(parts, str(personal)), whole_face(parts, str(personal))
    found = split(template, base, [read_expression(path, personal, base) for path in arguments.expressions])
    recipe = split.recipe(parts.recipe, personal, arguments.expressions, out, found)
    with face.deriving(out, flatten=arguments.flatten) as derived, named(personal):
        authored = author_shapes(derived, base, found.fit, recipe)
    report = found.fit.report
    missed = _misses(report)
    warnings = [*found.warnings, *authored.warnings, *missed]
    warn(warnings)
    result = {"path": str(out), **json.loads(report.to_json()), "flipped_triangles": found.flipped_triangles}
    result |= {"warnings": warnings, "missed": missed}
    emit(result, _text(out, report, found.flipped_triangles), as_json=arguments.json)
    return 1 if missed else 0


def _misses(report: SplitReport) -> list[str]:
    return [
        f"{scan}: shapes leave {left:.2f} mm of it (95th percentile), expected at most {_MOST_LEFT_MM:g} mm"
        for scan, left in report.residual_p95_mm.items()
        if left > _MOST_LEFT_MM
    ]


def _text(out: Path, report: SplitReport, flipped: int) -> str:
    seen = {name: one for name, one in report.shapes.items() if one.scans}
    shapes: list[tuple[str, ...]] = [("shape", "observed", "gain", "change mm", "scans")]
    for name, one in seen.items():
        shapes.append((name, f"{one.observed:.2f}", f"{one.gain:.2f}", f"{one.change_mm:.2f}", ", ".join(one.scans)))
    scans: list[tuple[str, ...]] = [("expression", "mean mm", "95 % mm", "weights")]
    for name, weights in report.weights.items():
        left = (f"{report.residual_mean_mm[name]:.2f}", f"{report.residual_p95_mm[name]:.2f}")
        scans.append((name, *left, ", ".join(f"{shape} {weight:.2f}" for shape, weight in weights.items())))
    kept = len(report.shapes) - len(seen)
    last = (
        f"{len(seen)} shapes of scans, {report.rank} told apart; {kept} as the personal template has them; "
        f"{flipped} triangles flipped"
    )
    return "\n".join([str(out), table(shapes), "", table(scans), "", last])
