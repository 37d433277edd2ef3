"""An actor's own shapes authored over the personal template."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from facepipe.core.errors import InputError
from facepipe.declare import to_json
from facepipe.geometry.polygons import flipped_triangles
from facepipe.kinds import found_of
from facepipe.parts import Recipe
from facepipe.processors.database import WholeFace, quality_from
from facepipe.processors.rebuild.author_neutral import AuthorNeutral, AuthorNeutralReport
from facepipe.processors.rebuild.expression_file import ExpressionFile
from facepipe.processors.rebuild.split_expressions import SplitExpressions, SplitFit
from facepipe.processors.rebuild.template import Template
from facepipe.stage import Face


@dataclass(frozen=True, kw_only=True)
class ActorShapes:
    """What a split found."""

    fit: SplitFit
    flipped_triangles: int  # in some shape, where the personal template's has them upright
    warnings: tuple[str, ...]


def split_files(
    split: SplitExpressions, template: Template, base: WholeFace, expressions: Sequence[ExpressionFile]
) -> ActorShapes:
    """Split expressions that were read from files.

    :param base: the personal template's neutral and shapes
    :raises InputError: no expression, two of one name, or one of shapes that are not there
    """
    names = [one.name for one in expressions]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InputError(base.name, f"two expressions are called '{twice}', expected each name once")
    composites = {one.name: one.composite for one in expressions}
    fit = split(template, base.points, base.deltas, composites)
    told = tuple(line for one in expressions for line in one.warnings)
    flipped = np.zeros(len(template.topology.triangles), bool)
    for name in seen_shapes(fit):
        before, after = (base.points + deltas[name] for deltas in (base.deltas, fit.shapes))
        flipped |= flipped_triangles(before, after, template.topology.triangles)
    return ActorShapes(fit=fit, flipped_triangles=int(flipped.sum()), warnings=(*told, *fit.report.warnings))


def author_shapes(face: Face, base: WholeFace, fit: SplitFit, recipe: Recipe) -> AuthorNeutralReport:
    """Author the shapes that scans told of on `face`, which stands over the personal template.

    :raises TopologyError, InputError: as `AuthorNeutral`
    """
    shapes = {name: fit.shapes[name] for name in seen_shapes(fit)}
    return AuthorNeutral(shapes=shapes)(face, base.points, recipe=recipe)


def seen_shapes(fit: SplitFit) -> tuple[str, ...]:
    """Shapes that some scan shows; the others are the personal template's to the bit."""
    return tuple(name for name, one in fit.report.shapes.items() if one.scans)


def quality_with(before: Recipe | None, where: str, flipped: int) -> dict[str, Any]:
    """The measures in the recipe of a personal template, with the triangles that shapes turn over counted in.

    :raises InputError: damaged measures
    """
    known = found_of(before)
    if "quality" not in known:
        return {}
    quality = quality_from(known["quality"], f"{where} -> recipe -> quality")
    return {"quality": to_json(replace(quality, flipped_triangles=quality.flipped_triangles + flipped))}
