"""Registered expressions as face stages: a shape over the personal template that holds all of the expression.

Beside the shape they hold what splitting asks for: which points the scan showed, as a primvar, and the weights that the
scan was to show, in the recipe. The shape may be corrected by hand before it is split.

Splitting begins with the weights given, and finds them anew beside the shapes: those that registration found hold how
much more or less than the template the person moves, which is the shapes' own.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError, SchemaError, TopologyError
from facepipe.core.tokens import SCANNED
from facepipe.parts import Recipe
from facepipe.scanning.rebuild.register_scans import Composite
from facepipe.scanning.rebuild.template import resolved
from facepipe.stage import Face, open_face
from facepipe.stage.recipes import recipe_of, source_digest
from facepipe.verbs.author_neutral import AuthorNeutral, AuthorNeutralReport
from facepipe.verbs.whole_faces import WholeFace, whole_face

_SAME_MM = 0.01  # neutrals that differ by less are one


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


def read_expression(path: Path, personal: Path, base: WholeFace) -> tuple[str, Composite, tuple[str, ...]]:
    """The expression that `author_expression` has left in `path`, to be split over `base`: its shape's name, what it
    is, and warnings.

    :param personal: file of the personal template, whose face is `base`
    :raises InputError: no file, none of `facepipe register-scan`, or one over another neutral
    :raises TopologyError: other meshes or faces
    :raises SchemaError: a damaged recipe, or no shape of its name
    """
    (recipe, _), where = recipe_of(path, "register-scan"), f"{path} -> recipe"
    options = recipe.options if isinstance(recipe.options, Mapping) else {}
    name, asked = options.get("name"), options.get("weights")
    if not isinstance(name, str) or not isinstance(asked, Mapping) or not asked:
        raise SchemaError(where, "expected the expression's name and weights")
    for shape, weight in asked.items():
        if not isinstance(weight, int | float) or not abs(weight) < 1e300:  # NaN fails, and integers beyond any float
            raise SchemaError(f"{where} -> weights -> {shape}", f"{weight!r:.40}, expected a finite number")
    face = open_face(path)
    whole = whole_face(face.parts(), str(path))
    if whole.topology.digest != base.topology.digest:
        raise TopologyError(path, f"other meshes or faces than {personal}, expected the same")
    off = float(np.linalg.norm(whole.points - base.points, axis=1).max(initial=0.0))
    if off > _SAME_MM:
        raise InputError(path, f"stands on a neutral that is up to {off:.2f} mm from that of {personal}")
    if name not in whole.deltas:
        raise SchemaError(path, f"has no shape '{name}', expected that of its recipe")
    weights = {str(shape): float(weight) for shape, weight in asked.items()}
    composite = Composite(
        points=base.points + whole.deltas[name],
        weights=resolved(weights, tuple(base.deltas), f"{where} -> weights"),
        matched=np.nan_to_num(face.primvar(SCANNED)) > 0.5,
    )
    known = dict(zip(recipe.sources, recipe.digests, strict=True)).get(str(options.get("personal")))
    is_same = known == source_digest(personal)
    return name, composite, () if is_same else (f"{personal.name} is not what {path.name} was registered with",)
