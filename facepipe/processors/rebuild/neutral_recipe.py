"""Recipes of neutrals: what they were fitted with or refined on, and how well they lie on their scans."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping, Sequence

from facepipe.declare import to_json
from facepipe.parts import Recipe
from facepipe.processors.database import Quality
from facepipe.processors.rebuild.options import FitNeutralOptions, RefineNeutralOptions
from facepipe.processors.rebuild.stage_recipe import stage_recipe

VERB = "fit-neutral"
REFINED = "refine-neutral"

AnyPath = str | os.PathLike[str]


def neutral_recipe(
    template: AnyPath,
    scan: AnyPath,
    database: AnyPath,
    out: AnyPath,
    options: FitNeutralOptions,
    quality: Quality,
    landmarks: AnyPath | None = None,
    weights: Mapping[str, float] | None = None,
    found: Mapping[str, float] | None = None,
) -> Recipe:
    """The recipe to author on a neutral that is saved as `out`.

    Sources are the template, the scan, the database and the landmarks, as seen from the folder of `out`.

    :param landmarks: their file; None where they were found on the scan
    :param weights: of the shapes that the scan shows besides, as given, and `found` as found
    :raises InputError: a source that can't be read
    """
    files = {"template": template, "scan": scan, "database": database}
    files |= {} if landmarks is None else {"landmarks": landmarks}
    content = {"options": to_json(options), "quality": dataclasses.asdict(quality)}
    content |= {"weights": dict(weights), "found": dict(found or {})} if weights else {}
    return stage_recipe(VERB, files, out, content)


def refined_recipe(
    neutral: AnyPath,
    scan: AnyPath,
    landmarks: AnyPath | None,
    out: AnyPath,
    regions: Sequence[str],
    options: RefineNeutralOptions,
    quality: Quality,
    shown: Mapping[str, float],
    weights: Mapping[str, float] | None = None,
) -> Recipe:
    """The recipe to author on a refined neutral that is saved as `out`.

    :param landmarks: their file; None where they were found on the scan
    :param regions: that could follow; none: all
    :param shown: weights of the shapes that the scan shows besides
    :param weights: those, where they were given; otherwise they are the neutral's
    :raises InputError: a source that can't be read
    """
    files = {"neutral": neutral, "scan": scan}
    files |= {} if landmarks is None else {"landmarks": landmarks}
    content = {"regions": list(regions), "options": to_json(options), "quality": dataclasses.asdict(quality)}
    content |= {"found": dict(shown)} if shown else {}
    content |= {"weights": dict(weights)} if weights else {}
    return stage_recipe(REFINED, files, out, content)


def flipped_before(recipe: Recipe | None) -> int:
    """Triangles that a neutral has turned over by its recipe, 0 where that says nothing."""
    quality = None if recipe is None else recipe.options.get("quality")
    found = quality.get("flipped_triangles") if isinstance(quality, Mapping) else None
    return found if isinstance(found, int) and found > 0 else 0


def shown_before(recipe: Recipe | None) -> dict[str, float]:
    """Weights of the shapes that the scan of a neutral shows besides, as its recipe says that they were found."""
    found = None if recipe is None else recipe.options.get("found")
    if not isinstance(found, Mapping) or not all(isinstance(one, int | float) for one in found.values()):
        return {}
    return {str(name): float(weight) for name, weight in found.items() if 0.0 < weight <= 2.0}
