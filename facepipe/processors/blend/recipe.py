"""The recipe of a blend: what it takes to blend again after a change."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from facepipe import __version__
from facepipe.core.errors import InputError, SchemaError
from facepipe.declare import from_json, to_json
from facepipe.parts import Recipe
from facepipe.processors.blend.options import BlendOptions
from facepipe.processors.blend.weights import Weights
from facepipe.processors.blend.weights_json import weights_from_json, weights_to_json
from facepipe.stage.files import relative_path
from facepipe.stage.recipes import changed_sources, existing_source, recipe_of, source_digest

VERB = "blend"


@dataclass(frozen=True, kw_only=True)
class BlendRecipe:
    """A recipe read back: `Blend(weights=..., options=...)` on the opened `sources` makes the same face again."""

    sources: tuple[Path, ...]  # absolute; files that are there
    weights: Weights
    options: BlendOptions
    standalone: bool  # it was saved without reference to its base
    warnings: tuple[str, ...] = ()  # sources that have changed since, one line each


def blend_recipe(
    paths: Sequence[str | os.PathLike[str]],
    out: str | os.PathLike[str],
    weights: Weights,
    options: BlendOptions | None = None,
) -> Recipe:
    """The recipe to author on a blend of the faces at `paths` that is saved as `out`.

    Sources are written as seen from the folder of `out`; a digest covers every USD layer that its source stands on,
    and no textures: they change no blend.

    :param paths: the sources' files, in their order
    :param weights: those of the blend
    :param options: those of the blend or its session; default as there
    :raises InputError: a source can't be read
    """
    folder = Path(out).absolute().parent
    return Recipe(
        verb=VERB,
        sources=tuple(relative_path(str(path), folder) for path in paths),
        digests=tuple(source_digest(Path(path)) for path in paths),
        options={"weights": weights_to_json(weights), "options": to_json(options or BlendOptions())},
        version=__version__,
    )


def read_blend_recipe(path: str | os.PathLike[str], replaced: Mapping[int, Path] | None = None) -> BlendRecipe:
    """The recipe on the blended face of a USD file; its other layers may be lost.

    :param replaced: number of a source, from 1 -> the file that takes its place
    :raises InputError: no recipe of a blend, a source that is not where it was, or no such number in `replaced`
    :raises SchemaError: a damaged recipe, or one of a newer facepipe
    """
    file, replaced = Path(path), replaced or {}
    recipe, standalone = recipe_of(file, VERB)
    where = f"{file} -> recipe"
    weights, options = _settings(where, recipe.options)
    sources = _sources(where, recipe, file.absolute().parent, replaced)
    kept = [
        (source, old)
        for number, (source, old) in enumerate(zip(sources, recipe.digests, strict=True), 1)
        if number not in replaced
    ]
    return BlendRecipe(
        sources=sources,
        weights=weights,
        options=options,
        standalone=standalone,
        warnings=changed_sources(file, kept),
    )


def _settings(where: str, content: object) -> tuple[Weights, BlendOptions]:
    if not isinstance(content, Mapping) or set(content) != {"weights", "options"}:
        raise SchemaError(where, "options are damaged, expected an object of weights and options")
    try:
        weights = weights_from_json(content["weights"], f"{where} -> weights")
        return weights, from_json(BlendOptions, content["options"], f"{where} -> options")
    except InputError as error:
        raise SchemaError(error.where, error.what) from None


def _sources(where: str, recipe: Recipe, folder: Path, replaced: Mapping[int, Path]) -> tuple[Path, ...]:
    count = len(recipe.sources)
    for number in replaced:
        if not 1 <= number <= count:
            raise InputError(f"--replace {number}", f"no such source, expected a number from 1 to {count}")
    return tuple(
        existing_source(f"{where} -> source {number}", replaced.get(number, folder / source), "--replace")
        for number, source in enumerate(recipe.sources, 1)
    )
