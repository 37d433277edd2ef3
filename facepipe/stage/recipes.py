"""Recipes of files whose layers may be lost."""

from __future__ import annotations

import os
from typing import NamedTuple

from facepipe.errors import FacepipeError
from facepipe.parts import Recipe
from facepipe.stage.files import open_stage
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
