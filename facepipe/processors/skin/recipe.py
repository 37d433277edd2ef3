"""The recipe of a skinned face: what it takes to skin again after a change."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from facepipe import __version__
from facepipe.core.errors import InputError, SchemaError
from facepipe.declare import from_json, to_json
from facepipe.parts import Recipe
from facepipe.processors.skin.options import SkinOptions
from facepipe.stage.files import relative_path
from facepipe.stage.recipes import changed_sources, existing_source, recipe_of, source_digest

VERB = "skin"

_WAYS = {"joints": "--joints", "face": "--from"}  # what the skeleton came from -> the argument that names it
_KEYS = {"from", "optimise", "options"}


@dataclass(frozen=True, kw_only=True)
class SkinRecipe:
    """A recipe read back: its options and sources skin the same face again.

    >>> recipe = read_skin_recipe("skinned.usda")
    >>> joints = None if recipe.joints is None else read_joints(recipe.joints)
    >>> source = None if recipe.source is None else facepipe.open(recipe.source)
    >>> with facepipe.open(recipe.face).deriving("again.usda") as face:
    ...     SkinFace(joints=joints, source=source, optimise=recipe.optimise, options=recipe.options)(face)
    """

    face: Path  # absolute, as all files
    joints: Path | None  # the file of joints; or
    source: Path | None  # the other face
    optimise: bool
    options: SkinOptions
    standalone: bool  # the result was saved without reference to its face
    warnings: tuple[str, ...] = ()  # sources that have changed since, one line each


def skin_recipe(
    face: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    joints: str | os.PathLike[str] | None = None,
    source: str | os.PathLike[str] | None = None,
    optimise: bool = False,
    options: SkinOptions | None = None,
) -> Recipe:
    """The recipe to author on the face of a path, skinned and saved as `out`.

    Sources are the face, and the file of joints or the other face, as seen from the folder of `out`; the digest of a
    face covers every USD layer that it stands on.

    :raises InputError: a source can't be read, or not one of `joints` and `source`
    """
    if (joints is None) == (source is None):
        raise InputError(VERB, "joints and a source face, or neither, expected one of them")
    folder = Path(out).absolute().parent
    files = [os.fspath(face), os.fspath(joints if source is None else source)]  # type: ignore[arg-type]
    return Recipe(
        verb=VERB,
        sources=tuple(relative_path(file, folder) for file in files),
        digests=tuple(source_digest(Path(file)) for file in files),
        options={
            "from": "joints" if source is None else "face",
            "optimise": optimise,
            "options": to_json(options or SkinOptions()),
        },
        version=__version__,
    )


def read_skin_recipe(path: str | os.PathLike[str]) -> SkinRecipe:
    """The recipe on the skinned face of a USD file; its other layers may be lost.

    :raises InputError: no recipe of `facepipe skin`, or a source that is not where it was
    :raises SchemaError: a damaged recipe, or one of a newer facepipe
    """
    file = Path(path)
    recipe, standalone = recipe_of(file, VERB)
    where = f"{file} -> recipe"
    way, optimise, options = _settings(where, recipe.options)
    if len(recipe.sources) != 2:
        raise SchemaError(where, f"{len(recipe.sources)} sources, expected the face and what its skeleton came from")
    found = [
        existing_source(f"{where} -> source {number}", file.absolute().parent / source, instead)
        for number, (source, instead) in enumerate(zip(recipe.sources, ("FACE", _WAYS[way]), strict=True), 1)
    ]
    return SkinRecipe(
        face=found[0],
        joints=found[1] if way == "joints" else None,
        source=found[1] if way == "face" else None,
        optimise=optimise,
        options=options,
        standalone=standalone,
        warnings=changed_sources(file, zip(found, recipe.digests, strict=True)),
    )


def _settings(where: str, content: object) -> tuple[str, bool, SkinOptions]:
    if not isinstance(content, Mapping) or set(content) != _KEYS:
        raise SchemaError(where, f"options are damaged, expected an object of {', '.join(sorted(_KEYS))}")
    way, optimise = content["from"], content["optimise"]
    if not isinstance(way, str) or way not in _WAYS:
        raise SchemaError(f"{where} -> from", f"{str(way)[:40]}, expected one of {', '.join(_WAYS)}")
    if not isinstance(optimise, bool):
        raise SchemaError(f"{where} -> optimise", f"{str(optimise)[:40]}, expected true or false")
    try:
        return way, optimise, from_json(SkinOptions, content["options"], f"{where} -> options")
    except InputError as error:
        raise SchemaError(error.where, error.what) from None
