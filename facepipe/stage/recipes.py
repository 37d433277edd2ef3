"""Recipes of files whose layers may be lost, and digests of the sources that recipes name."""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

from facepipe.digests import digest
from facepipe.errors import FacepipeError
from facepipe.parts import Recipe
from facepipe.stage.files import SUFFIXES, dependencies, open_stage
from facepipe.stage.read_skeleton import read_recipe


class FileRecipe(NamedTuple):
    """The recipe of a file, and whether the file stands on no other layer."""

    recipe: Recipe | None
    standalone: bool


def file_recipe(path: str | os.PathLike[str]) -> FileRecipe:
    """The recipe on the default prim of a USD file, also where the layers that it stands on are lost.

    :raises InputError, SchemaError: no readable USD file, or a damaged recipe
    """
    stage = open_stage(path, strict=False)
    prim = stage.GetDefaultPrim()
    try:
        recipe = read_recipe(prim) if prim else None
    except FacepipeError as error:
        raise error.under(os.fspath(path)) from None
    return FileRecipe(recipe, not stage.GetRootLayer().subLayerPaths)


def source_digest(path: Path) -> str:
    """The digest of a face and of every USD layer that it stands on.

    :raises InputError: a file can't be read
    """
    layers = {path.resolve()} | {one for one in dependencies(path) if one.suffix.lower() in SUFFIXES}
    return digest({one.resolve() for one in layers})
