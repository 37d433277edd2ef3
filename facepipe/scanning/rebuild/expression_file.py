"""Registered expressions as face stages: a shape over the personal template that holds all of the expression.

Beside the shape they hold what splitting asks for: which points the scan showed, as a primvar, and the weights that the
scan was to show, in the recipe. The shape may be corrected by hand before it is split.

Splitting begins with the weights given, and finds them anew beside the shapes: those that registration found hold how
much more or less than the template the person moves, which is the shapes' own.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError, SchemaError, TopologyError
from facepipe.core.tokens import SCANNED
from facepipe.declare import to_json
from facepipe.geometry.polygons import flipped_triangles
from facepipe.kinds import found_of
from facepipe.parts import Recipe
from facepipe.scanning.database import quality_from
from facepipe.scanning.rebuild.register_scans import Composite
from facepipe.scanning.rebuild.split_expressions import SplitExpressions, SplitFit
from facepipe.scanning.rebuild.template import Template, resolved
from facepipe.stage import Face, open_face
from facepipe.stage.recipes import recipe_of, source_digest
from facepipe.verbs.author_neutral import AuthorNeutral, AuthorNeutralReport
from facepipe.verbs.whole_faces import WholeFace, whole_face

AnyPath = str | os.PathLike[str]

_SAME_MM = 0.01  # neutrals that differ by less are one


@dataclass(frozen=True, kw_only=True)
class ExpressionFile:
    """An expression that was read."""

    name: str  # of its shape
    composite: Composite
    warnings: tuple[str, ...] = ()


def author_expression(
    face: Face, name: str, neutral: FloatArray, composite: Composite, recipe: Recipe
) -> AuthorNeutralReport:
    """Author an expression as the shape `name` on `face`, which stands over the personal template.

    :param neutral: (n, 3) whole points of the personal template
    :param recipe: with the expression's name, and the weights that it was to show, under "name" and "weights"
    :raises TopologyError, InputError: as `AuthorNeutral`
    """
    author = AuthorNeutral(
        shapes={name: composite.points - neutral}, primvars={SCANNED: composite.matched.astype(np.float32)}
    )
    return author(face, neutral, recipe=recipe)


def read_expression(path: Path, personal: AnyPath, base: WholeFace) -> ExpressionFile:
    """The expression that `author_expression` has left in `path`, to be split over `base`.

    :param personal: file of the personal template, whose face is `base`
    :raises InputError: no file, none of `facepipe register-scan`, or one over another neutral
    :raises TopologyError: other meshes or faces
    :raises SchemaError: a damaged recipe, or no shape of its name
    """
    recipe, _ = recipe_of(path, "register-scan")
    name, asked = _asked(recipe, f"{path} -> recipe")
    face = open_face(path)
    whole = whole_face(face.parts(), str(path))
    if whole.topology.digest != base.topology.digest:
        raise TopologyError(path, f"other meshes or faces than {personal}, expected the same")
    off = float(np.linalg.norm(whole.points - base.points, axis=1).max(initial=0.0))
    if off > _SAME_MM:
        raise InputError(path, f"stands on a neutral that is up to {off:.2f} mm from that of {personal}")
    if name not in whole.deltas:
        raise SchemaError(path, f"has no shape '{name}', expected that of its recipe")
    weights = resolved(asked, tuple(base.deltas), f"{path} -> recipe -> weights")
    scanned = np.nan_to_num(face.primvar(SCANNED)) > 0.5
    composite = Composite(points=base.points + whole.deltas[name], weights=weights, matched=scanned)
    return ExpressionFile(name=name, composite=composite, warnings=_changes(path, recipe, Path(personal)))


def _asked(recipe: Recipe, where: str) -> tuple[str, dict[str, float]]:
    """Name and weights in a recipe."""
    options = recipe.options
    name, weights = (options.get(one) if isinstance(options, Mapping) else None for one in ("name", "weights"))
    if not isinstance(name, str) or not isinstance(weights, Mapping) or not weights:
        raise SchemaError(where, "expected the expression's name and weights")
    for shape, weight in weights.items():
        if not isinstance(weight, int | float) or not abs(weight) < 1e300:  # NaN fails, and integers beyond any float
            raise SchemaError(f"{where} -> weights -> {shape}", f"{weight!r:.40}, expected a finite number")
    return name, {str(shape): float(weight) for shape, weight in weights.items()}


def _changes(path: Path, recipe: Recipe, personal: Path) -> tuple[str, ...]:
    """What to say where the personal template is not what the expression was registered with."""
    seen = str(recipe.options.get("personal"))
    known = dict(zip(recipe.sources, recipe.digests, strict=True)).get(seen)
    if known == source_digest(personal):
        return ()
    return (f"{personal.name} is not what {path.name} was registered with",)


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
    names = [expression.name for expression in expressions]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InputError(base.name, f"two expressions are called '{twice}', expected each name once")
    composites = {expression.name: expression.composite for expression in expressions}
    fit = split(template, base.points, base.deltas, composites)
    warnings = tuple(line for expression in expressions for line in expression.warnings)
    flipped = np.zeros(len(template.topology.triangles), bool)
    for name in seen_shapes(fit):
        before, after = (base.points + deltas[name] for deltas in (base.deltas, fit.shapes))
        flipped |= flipped_triangles(before, after, template.topology.triangles)
    return ActorShapes(fit=fit, flipped_triangles=int(flipped.sum()), warnings=(*warnings, *fit.report.warnings))


def author_shapes(face: Face, base: WholeFace, fit: SplitFit, recipe: Recipe) -> AuthorNeutralReport:
    """Author the shapes that scans show on `face`, which stands over the personal template.

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
