"""A person's own shapes: split by `facepipe split-shapes`, and again from their recipes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

from facepipe.kinds import Watch
from facepipe.pipeline.rebuild_stage import read_stage_recipe
from facepipe.pipeline.verbs import Cooked
from facepipe.processors.database import whole_face
from facepipe.processors.rebuild import SplitExpressions, SplitExpressionsOptions, SplitReport, Template
from facepipe.processors.rebuild.author_split import VERB, SplitFiles, author_shapes
from facepipe.processors.rebuild.expression_file import read_expression
from facepipe.processors.rebuild.scan_input import named
from facepipe.stage import open_face

_MOST_LEFT_MM = 2.0  # 95th percentile of what shapes leave of an expression


@dataclass(frozen=True, kw_only=True)
class SplitJob:
    """Expressions to split."""

    personal: Path
    expressions: Sequence[Path]
    out: Path
    options: SplitExpressionsOptions = field(default_factory=SplitExpressionsOptions)
    flatten: bool = False


class Split(NamedTuple):
    """Shapes that are saved."""

    report: SplitReport  # its warnings are all that there are
    flipped_triangles: int
    missed: tuple[str, ...]  # a line for each limit


def cook(path: Path, watch: Watch) -> Cooked:
    """Split again in the place of the result at `path`.

    :raises FacepipeError: a recipe or sources that can't be read or split
    """
    recipe = read_stage_recipe(path, VERB)
    job = SplitJob(
        personal=recipe.file("personal"),
        expressions=recipe.several("expressions"),
        out=path,
        options=recipe.options(SplitExpressionsOptions),
        flatten=recipe.standalone,
    )
    made = make(job)
    return Cooked(report=made.report, missed=bool(made.missed))


def make(job: SplitJob) -> Split:
    """Read, split, author, save.

    :raises FacepipeError: what can't be read, split or written
    """
    split = SplitFiles(split=SplitExpressions(options=job.options))
    face = open_face(job.personal)
    parts = face.parts()
    template, base = Template.of(parts, str(job.personal)), whole_face(parts, str(job.personal))
    found = split(template, base, [read_expression(path, job.personal, base) for path in job.expressions])
    recipe = split.recipe(parts.recipe, job.personal, job.expressions, job.out, found)
    with face.deriving(job.out, flatten=job.flatten) as derived, named(job.personal):
        authored = author_shapes(derived, base, found.fit, recipe)
    report, missed = found.fit.report, _misses(found.fit.report)
    told = (*found.warnings, *authored.warnings, *missed)
    return Split(replace(report, warnings=told), found.flipped_triangles, missed)


def _misses(report: SplitReport) -> tuple[str, ...]:
    return tuple(
        f"{scan}: shapes leave {left:.2f} mm of it (95th percentile), expected at most {_MOST_LEFT_MM:g} mm"
        for scan, left in report.residual_p95_mm.items()
        if left > _MOST_LEFT_MM
    )
