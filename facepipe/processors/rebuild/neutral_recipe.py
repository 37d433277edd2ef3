"""Recipes of neutrals: what they were fitted with or refined on, and how well they lie on their scans."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping, Sequence

from facepipe.declare import to_json
from facepipe.older_recipes import found_of
from facepipe.parts import Recipe
from facepipe.processors.database import Quality
from facepipe.processors.rebuild.options import RefineNeutralOptions
from facepipe.processors.rebuild.stage_recipe import stage_recipe

REFINED = "refine-neutral"

AnyPath = str | os.PathLike[str]


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
    quality = found_of(recipe).get("quality")
    found = quality.get("flipped_triangles") if isinstance(quality, Mapping) else None
    return found if isinstance(found, int) and found > 0 else 0


def shown_before(recipe: Recipe | None) -> dict[str, float]:
    """Weights of the shapes that the scan of a neutral shows besides, as its recipe says that they were found."""
    found = found_of(recipe).get("weights")
    if not isinstance(found, Mapping) or not all(isinstance(one, int | float) for one in found.values()):
        return {}
    return {str(name): float(weight) for name, weight in found.items() if 0.0 < weight <= 2.0}
