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
from facepipe.cli.show import emit, warn
from facepipe.core.texts import table

if TYPE_CHECKING:
    from facepipe.processors.rebuild import SplitReport


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
    from facepipe.pipeline.split_shapes import SplitJob, make
    from facepipe.processors.rebuild import SplitExpressionsOptions

    out = output_of(arguments, [arguments.personal, *arguments.expressions])
    options = options_from(arguments, SplitExpressionsOptions)
    files = {"personal": arguments.personal, "expressions": arguments.expressions}
    report, flipped, missed = make(SplitJob(**files, out=out, options=options, flatten=arguments.flatten))
    warn(report.warnings)
    result = {"path": str(out), **json.loads(report.to_json()), "flipped_triangles": flipped, "missed": list(missed)}
    emit(result, _text(out, report, flipped), as_json=arguments.json)
    return 1 if missed else 0


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
