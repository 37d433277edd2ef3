"""Split registered expressions into the person's own shapes.

EXPRESSIONs are what `facepipe register-scan` made over --personal, as they are or with the shape corrected by hand.
Each is a sum of the shapes that its recipe names; together they show how this person's shapes differ from the personal
template's. Shapes that no scan shows stay as they are.

OUT is an override layer over --personal. --flatten writes a standalone file. The table gives for each shape that scans
show: how much of it they decided (the rest being the template's), its motion along the template's (1: as much), how
far it is from the template's, and which scans show it. Exit code 1: done, but what the shapes leave of an expression
is over 2 mm at more than one point in twenty.

examples:
  facepipe split-shapes work/smile.usda work/anger.usda --personal personal.usdc -o actor.usdc
  facepipe split-shapes work/*.usda --personal personal.usdc -o actor.usdc --flatten --json
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facepipe.core.errors import InputError
from facepipe.core.reports import table
from facepipe.declare import source, to_json
from facepipe.kinds import Job, StageAction, action, found_of
from facepipe.scanning.rebuild.declared import SplitExpressionsOptions

if TYPE_CHECKING:
    from facepipe.scanning.rebuild.split_expressions import SplitShapesReport
    from facepipe.stage import Face

_MOST_LEFT_MM = 2.0  # 95th percentile of what shapes leave of an expression


@action("split-shapes", "split scanned expressions into the person's own shapes")
@dataclass(frozen=True, kw_only=True)
class SplitShapesAction(SplitExpressionsOptions, StageAction["SplitShapesReport"]):
    """The action."""

    personal: Path = source("what they were registered with", flag="--personal", metavar="FACE")
    expressions: tuple[Path, ...] = source("what `facepipe register-scan` made", metavar="EXPRESSION")

    def author(self, face: Face, job: Job) -> SplitShapesReport:
        from facepipe.scanning.database import quality_from
        from facepipe.scanning.rebuild.split_expressions import read_expression, split_expressions, turned_over
        from facepipe.scanning.rebuild.template import Template
        from facepipe.verbs.author_neutral import AuthorNeutral
        from facepipe.verbs.whole_faces import whole_face

        parts, where = face.parts(), str(self.personal)
        template, base = Template.of(parts, where), whole_face(parts, where)
        read = [read_expression(Path(path), Path(self.personal), base) for path in self.expressions]
        names = [name for name, _, _ in read]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise InputError(base.name, f"two expressions are called '{twice}', expected each name once")
        composites = {name: composite for name, composite, _ in read}
        shapes, report = split_expressions(template, base.points, base.deltas, composites, self)
        seen = {name: shapes[name] for name in report.seen}
        flipped = turned_over(template, base.points, base.deltas, seen)
        before = found_of(parts.recipe)
        found: dict[str, Any] = {"weights": report.weights}
        if "quality" in before:  # the personal template's measures, with the triangles that shapes turn over
            quality = quality_from(before["quality"], f"{where} -> recipe -> quality")
            found["quality"] = to_json(replace(quality, flipped_triangles=quality.flipped_triangles + flipped))
        authored = AuthorNeutral(shapes=seen)(face, base.points, recipe=job.recipe(**found))
        missed = tuple(
            f"{scan}: shapes leave {left:.2f} mm of it (95th percentile), expected at most {_MOST_LEFT_MM:g} mm"
            for scan, left in report.residual_p95_mm.items()
            if left > _MOST_LEFT_MM
        )
        lines = (*(line for _, _, notes in read for line in notes), *report.warnings, *authored.warnings, *missed)
        return replace(report, flipped_triangles=flipped, missed=missed, warnings=lines)

    def text(self, report: SplitShapesReport, out: Path) -> str:
        shapes: list[tuple[str, ...]] = [("shape", "observed", "gain", "change mm", "scans")]
        for name in report.seen:
            one = report.shapes[name]
            numbers = (f"{one.observed:.2f}", f"{one.gain:.2f}", f"{one.change_mm:.2f}")
            shapes.append((name, *numbers, ", ".join(one.scans)))
        scans: list[tuple[str, ...]] = [("expression", "mean mm", "95 % mm", "weights")]
        for name, weights in report.weights.items():
            left = (f"{report.residual_mean_mm[name]:.2f}", f"{report.residual_p95_mm[name]:.2f}")
            scans.append((name, *left, ", ".join(f"{shape} {weight:.2f}" for shape, weight in weights.items())))
        kept = len(report.shapes) - len(report.seen)
        last = (
            f"{len(report.seen)} shapes of scans, {report.rank} separated; {kept} as the personal template has them; "
            f"{report.flipped_triangles} triangles flipped"
        )
        return "\n".join([str(out), table(shapes), "", table(scans), "", last])
