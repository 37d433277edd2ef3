"""Split registered expressions into the person's own shapes.

EXPRESSIONs are what `facepipe register-scan` made over --personal, as they are or with the shape corrected by hand.
Each is a sum of the shapes that its recipe names; together they show how this person's shapes differ from the personal
template's. Shapes that no scan shows stay as they are.

OUT is an override layer over --personal. --flatten writes a standalone file. The table gives for each shape that scans
show: how much of it they decided (the rest being the template's), its motion along the template's (1: as much), how
far it is from the template's, and which scans show it. Exit code 1: done, but what the shapes leave of an expression
is over 2 mm at more than one point in twenty.

examples:
  facepipe split-shapes work/smile.usda work/anger.usda --personal personal.usda -o actor.usda
  facepipe split-shapes work/*.usda --personal personal.usda -o actor.usda --flatten --json
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.core.reports import table
from facepipe.declare import source
from facepipe.kinds import Job, StageAction, action
from facepipe.scanning.rebuild.options import SplitExpressionsOptions

if TYPE_CHECKING:
    from facepipe.scanning.rebuild.action_reports import SplitShapesReport
    from facepipe.scanning.rebuild.split_expressions import SplitReport
    from facepipe.stage import Face

_MOST_LEFT_MM = 2.0  # 95th percentile of what shapes leave of an expression


@action("split-shapes", "split scanned expressions into the person's own shapes")
@dataclass(frozen=True, kw_only=True)
class SplitShapesAction(SplitExpressionsOptions, StageAction["SplitShapesReport"]):
    """The action."""

    personal: Path = source("what they were registered with", flag="--personal", metavar="FACE")
    expressions: tuple[Path, ...] = source("what `facepipe register-scan` made", metavar="EXPRESSION")

    def author(self, face: Face, job: Job) -> SplitShapesReport:
        from facepipe.scanning.rebuild.action_reports import SplitShapesReport
        from facepipe.scanning.rebuild.expression_file import (
            author_shapes,
            quality_with,
            read_expression,
            split_files,
        )
        from facepipe.scanning.rebuild.split_expressions import SplitExpressions
        from facepipe.scanning.rebuild.template import Template
        from facepipe.verbs.whole_faces import whole_face

        parts = face.parts()
        template, base = Template.of(parts, str(self.personal)), whole_face(parts, str(self.personal))
        read = [read_expression(Path(path), self.personal, base) for path in self.expressions]
        actor = split_files(SplitExpressions(options=self), template, base, read)
        report, quality = actor.fit.report, quality_with(parts.recipe, str(self.personal), actor.flipped_triangles)
        authored = author_shapes(face, base, actor.fit, job.recipe(weights=report.weights, **quality))
        warnings = (*actor.warnings, *authored.warnings)
        return SplitShapesReport.from_report(
            report, warnings, _misses(report), flipped_triangles=actor.flipped_triangles
        )

    def text(self, report: SplitShapesReport, out: Path) -> str:
        seen = {name: one for name, one in report.shapes.items() if one.scans}
        shapes: list[tuple[str, ...]] = [("shape", "observed", "gain", "change mm", "scans")]
        for name, one in seen.items():
            numbers = (f"{one.observed:.2f}", f"{one.gain:.2f}", f"{one.change_mm:.2f}")
            shapes.append((name, *numbers, ", ".join(one.scans)))
        scans: list[tuple[str, ...]] = [("expression", "mean mm", "95 % mm", "weights")]
        for name, weights in report.weights.items():
            left = (f"{report.residual_mean_mm[name]:.2f}", f"{report.residual_p95_mm[name]:.2f}")
            scans.append((name, *left, ", ".join(f"{shape} {weight:.2f}" for shape, weight in weights.items())))
        kept = len(report.shapes) - len(seen)
        last = (
            f"{len(seen)} shapes of scans, {report.rank} separated; {kept} as the personal template has them; "
            f"{report.flipped_triangles} triangles flipped"
        )
        return "\n".join([str(out), table(shapes), "", table(scans), "", last])


def _misses(report: SplitReport) -> tuple[str, ...]:
    return tuple(
        f"{scan}: shapes leave {left:.2f} mm of it (95th percentile), expected at most {_MOST_LEFT_MM:g} mm"
        for scan, left in report.residual_p95_mm.items()
        if left > _MOST_LEFT_MM
    )
