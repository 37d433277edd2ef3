"""Recipes of a face, some files and plain options: written, and read back."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from facepipe import __version__
from facepipe.core.errors import SchemaError
from facepipe.parts import Recipe
from facepipe.stage.files import relative_path
from facepipe.stage.recipes import existing_source, recipe_of, source_digest


class SourceRecipe(NamedTuple):
    """A recipe read back."""

    files: tuple[Path, ...]  # absolute; they are there
    options: Mapping[str, object]
    standalone: bool  # the result was saved without reference to its face
    where: str  # the trail to it, for messages


def source_recipe(
    verb: str, files: Sequence[str | os.PathLike[str]], out: str | os.PathLike[str], options: Mapping[str, object]
) -> Recipe:
    """The recipe to author on a face that is made of `files` and saved as `out`; sources as seen from its folder.

    :param options: as JSON holds them
    :raises InputError: a source can't be read
    """
    folder = Path(out).absolute().parent
    return Recipe(
        verb=verb,
        sources=tuple(relative_path(os.fspath(one), folder) for one in files),
        digests=tuple(source_digest(Path(one)) for one in files),
        options=options,
        version=__version__,
    )


def read_source_recipe(path: Path, verb: str, arguments: Sequence[str]) -> SourceRecipe:
    """What `source_recipe` wrote on the face of a USD file; its other layers may be lost.

    :param arguments: what each source is given as
    :raises InputError: a recipe of another verb, or a source that is not where it was
    :raises SchemaError: a damaged recipe, or one of a newer facepipe
    """
    recipe, standalone = recipe_of(path, verb)
    where = f"{path} -> recipe"
    if len(recipe.sources) != len(arguments):
        raise SchemaError(where, f"{len(recipe.sources)} sources, expected {len(arguments)}: {', '.join(arguments)}")
    if not isinstance(recipe.options, Mapping):
        raise SchemaError(where, "options are damaged, expected an object")
    folder = path.absolute().parent
    files = tuple(
        existing_source(f"{where} -> source {number}", folder / source, argument)
        for number, (source, argument) in enumerate(zip(recipe.sources, arguments, strict=True), 1)
    )
    return SourceRecipe(files, recipe.options, standalone, where)
