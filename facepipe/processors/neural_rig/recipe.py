"""The recipe of a face with a neural rig: what it takes to apply the rig again after a change."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from facepipe import __version__
from facepipe.core.errors import InputError, SchemaError
from facepipe.declare import from_json, to_json
from facepipe.parts import Recipe
from facepipe.processors.neural_rig.options import AttachOptions
from facepipe.stage.files import relative_path
from facepipe.stage.recipes import changed_sources, existing_source, recipe_of, source_digest

VERB = "neural-rig"


@dataclass(frozen=True, kw_only=True)
class NeuralRigRecipe:
    """A recipe read back: it gives the same face again, and with the same recipe the same bytes.

    >>> recipe = read_neural_rig_recipe("neural.usda")
    >>> with facepipe.open(recipe.face).deriving("again.usda", flatten=recipe.standalone) as face:
    ...     ApplyNeuralRig(file=recipe.rig, options=recipe.options)(face, "again.usda")
    """

    face: Path  # absolute, as the other
    rig: Path  # .fpnr
    options: AttachOptions
    standalone: bool  # the result was saved without reference to its face
    warnings: tuple[str, ...] = ()  # sources that have changed since, one line each


def neural_rig_recipe(
    face: str | os.PathLike[str], rig: Path, out: str | os.PathLike[str], options: AttachOptions
) -> Recipe:
    """The recipe to author on the face of a path, saved as `out`: its sources are the face and the rig.

    :raises InputError: a source can't be read
    """
    files, folder = (os.fspath(face), os.fspath(rig)), Path(out).absolute().parent
    return Recipe(
        verb=VERB,
        sources=tuple(relative_path(one, folder) for one in files),
        digests=tuple(source_digest(Path(one)) for one in files),
        options=to_json(options),
        version=__version__,
    )


def read_neural_rig_recipe(path: str | os.PathLike[str]) -> NeuralRigRecipe:
    """The recipe on a face that a neural rig was applied to; the other layers of its file may be lost.

    :raises InputError: no recipe of `facepipe neural-rig`, or a source that is not where it was
    :raises SchemaError: a damaged recipe, or one of a newer facepipe
    """
    file = Path(path)
    recipe, standalone = recipe_of(file, VERB)
    where = f"{file} -> recipe"
    if len(recipe.sources) != 2:
        raise SchemaError(where, f"{len(recipe.sources)} sources, expected the face and the neural rig")
    try:
        options = from_json(AttachOptions, recipe.options, f"{where} -> options")
    except InputError as error:
        raise SchemaError(error.where, error.what) from None
    found = [
        existing_source(f"{where} -> source {number}", file.absolute().parent / source, instead)
        for number, (source, instead) in enumerate(zip(recipe.sources, ("FACE", "RIG"), strict=True), 1)
    ]
    return NeuralRigRecipe(
        face=found[0],
        rig=found[1],
        options=options,
        standalone=standalone,
        warnings=changed_sources(file, zip(found, recipe.digests, strict=True)),
    )
