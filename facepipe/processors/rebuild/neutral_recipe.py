"""The recipe of a neutral: what it was fitted with, and how well it lies on its scan."""

from __future__ import annotations

import dataclasses
import os

from facepipe.options import to_json
from facepipe.parts import Recipe
from facepipe.processors.database import Quality
from facepipe.processors.rebuild.fit_neutral import FitNeutralOptions
from facepipe.processors.rebuild.stage_recipe import stage_recipe

VERB = "fit-neutral"

AnyPath = str | os.PathLike[str]


def neutral_recipe(
    template: AnyPath,
    scan: AnyPath,
    database: AnyPath,
    out: AnyPath,
    options: FitNeutralOptions,
    quality: Quality,
    landmarks: AnyPath | None = None,
) -> Recipe:
    """The recipe to author on a neutral that is saved as `out`.

    Sources are the template, the scan, the database and the landmarks, as seen from the folder of `out`.

    :param landmarks: their file; None where they were found on the scan
    :raises InputError: a source that can't be read
    """
    files = {"template": template, "scan": scan, "database": database}
    files |= {} if landmarks is None else {"landmarks": landmarks}
    return stage_recipe(VERB, files, out, {"options": to_json(options), "quality": dataclasses.asdict(quality)})
