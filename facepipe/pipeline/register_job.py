"""What a registration is asked for, and how its recipe keeps that."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from facepipe.core.errors import InputError, SchemaError
from facepipe.declare import json_value, to_json
from facepipe.parts import Recipe
from facepipe.pipeline.rebuild_stage import read_stage_recipe
from facepipe.processors.rebuild import RegisterScansOptions, ScanFit, resolved
from facepipe.processors.rebuild.expression_file import VERB
from facepipe.processors.rebuild.stage_recipe import stage_recipe


@dataclass(frozen=True, kw_only=True)
class RegisterJob:
    """A scan to register."""

    scan: Path
    landmarks: Path | None  # None: to be found on the scan
    personal: Path
    neutral_scan: Path | None
    neutral_landmarks: Path | None
    neutral_weights: Mapping[str, float]  # what it shows besides, as they were given
    name: str  # of the shape
    weights: Mapping[str, float]  # as they were given
    said_by: str  # what gave them, for messages
    out: Path
    flatten: bool
    options: RegisterScansOptions = field(default_factory=RegisterScansOptions)

    def resolved(self, shapes: Sequence[str]) -> dict[str, float]:
        """The weights by the names of the face's shapes.

        :raises InputError: a shape that the face has not, or the expression's own name is one that it has
        """
        if self.name in shapes:
            raise InputError(f"{self.personal} -> {self.name}", "the face has such a shape, expected another --name")
        return resolved(self.weights, shapes, self.said_by)

    def recipe(self, given: Mapping[str, float], found: Mapping[str, float], fit: ScanFit) -> Recipe:
        """The recipe to author on the result.

        :param given: `resolved` weights
        :param found: the weights that the scan shows
        :raises InputError: a source that can't be read
        """
        files = {
            "personal": self.personal,
            "scan": self.scan,
            "landmarks": self.landmarks,
            "neutral_scan": self.neutral_scan,
            "neutral_landmarks": self.neutral_landmarks,
        }
        content = {
            "name": self.name,
            "weights": dict(given),
            "found": dict(found),
            "fit": json_value(dataclasses.asdict(fit)),
            "options": to_json(self.options),
        }
        content |= {"neutral_weights": dict(self.neutral_weights)} if self.neutral_weights else {}
        return stage_recipe(VERB, {what: file for what, file in files.items() if file is not None}, self.out, content)


def recipe_job(path: Path) -> RegisterJob:
    """The job of the recipe on a result, to be made in its place.

    :raises InputError: no recipe of a registration, or a source that is not where it was
    :raises SchemaError: a damaged recipe, or one of a newer facepipe
    """
    recipe = read_stage_recipe(path, VERB)
    name = recipe.content.get("name")
    if not isinstance(name, str) or not name:
        raise SchemaError(f"{recipe.where} -> name", f"{str(name)[:40]}, expected the name of a shape")
    return RegisterJob(
        scan=recipe.file("scan"),
        landmarks=recipe.optional("landmarks"),
        personal=recipe.file("personal"),
        neutral_scan=recipe.optional("neutral_scan"),
        neutral_landmarks=recipe.optional("neutral_landmarks"),
        neutral_weights=recipe.weights("neutral_weights"),
        name=name,
        weights=recipe.weights("weights"),
        said_by=f"{recipe.where} -> weights",
        out=path,
        flatten=recipe.standalone,
        options=recipe.options(RegisterScansOptions),
    )
