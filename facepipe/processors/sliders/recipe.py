"""The recipe of sliders that were authored or set: what it takes to do so again after a change."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from facepipe import __version__
from facepipe.core.errors import InputError, SchemaError
from facepipe.declare import from_json, to_json
from facepipe.parts import Recipe
from facepipe.processors.sliders.from_shapes import SlidersFromShapes
from facepipe.processors.sliders.set_sliders import SetSliders
from facepipe.processors.sliders.shape_recipe import maker_from_json, maker_to_json
from facepipe.stage.files import relative_path
from facepipe.stage.recipes import changed_sources, existing_source, recipe_of, source_digest

VERB = "sliders"


@dataclass(frozen=True, kw_only=True)
class TableOptions:
    """How a table was authored."""

    drop: bool = False
    network: bool = False  # it is no table, but a learned network


@dataclass(frozen=True, kw_only=True)
class SliderRecipe:
    """A recipe read back: it does the same to the same face again.

    >>> recipe = read_slider_recipe("posed.usda")
    >>> again = recipe.settings or recipe.shapes or AuthorSliders(table=read_table(recipe.table), drop=recipe.drop)
    >>> with facepipe.open(recipe.face).deriving("again.usda") as face:
    ...     again(face)
    """

    face: Path  # absolute, as all files
    table: Path | None  # what was authored, or
    network: Path | None = None  # the file of a learned network; or
    settings: SetSliders | None  # what was set; or
    shapes: SlidersFromShapes | None = None  # how sliders were made from the face's blendshapes
    drop: bool = False
    standalone: bool = False  # the result was saved without reference to its face
    warnings: tuple[str, ...] = ()  # sources that have changed since, one line each


def slider_recipe(
    face: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    table: str | os.PathLike[str] | None = None,
    network: str | os.PathLike[str] | None = None,
    drop: bool = False,
    settings: SetSliders | None = None,
    shapes: SlidersFromShapes | None = None,
) -> Recipe:
    """The recipe to author on the face of a path, saved as `out`: its sources are the face, and the table or network.

    :raises InputError: a source can't be read, or not one of `table`, `network`, `settings` and `shapes`
    """
    if sum(one is not None for one in (table, network, settings, shapes)) != 1:
        raise InputError(VERB, "several of a table, a network, settings and shapes, or none, expected one of them")
    folder = Path(out).absolute().parent
    files = [os.fspath(one) for one in (face, table, network) if one is not None]
    return Recipe(
        verb=VERB,
        sources=tuple(relative_path(file, folder) for file in files),
        digests=tuple(source_digest(Path(file)) for file in files),
        options=_options(table is not None, drop, network is not None, settings, shapes),
        version=__version__,
    )


def _options(
    tabled: bool, drop: bool, networked: bool, settings: SetSliders | None, shapes: SlidersFromShapes | None
) -> Mapping[str, object]:
    if tabled:
        return {"drop": drop}
    if networked:
        return {"network": True}
    return maker_to_json(shapes) if shapes else to_json(settings)  # type: ignore[arg-type]


def read_slider_recipe(path: str | os.PathLike[str]) -> SliderRecipe:
    """The recipe on the face of a USD file; its other layers may be lost.

    :raises InputError: no recipe of `facepipe sliders`, or a source that is not where it was
    :raises SchemaError: a damaged recipe, or one of a newer facepipe
    """
    file = Path(path)
    recipe, standalone = recipe_of(file, VERB)
    where, count = f"{file} -> recipe", len(recipe.sources)
    if count > 2:
        raise SchemaError(where, f"{count} sources, expected a face, and a table where one was authored")
    try:
        made = count == 1 and isinstance(recipe.options, Mapping) and "shapes" in recipe.options
        shapes = maker_from_json(where, recipe.options) if made else None
        settings = _settings(where, recipe.options) if count == 1 and not made else None
        authored = from_json(TableOptions, recipe.options, where) if count == 2 else TableOptions()
    except InputError as error:
        raise SchemaError(error.where, error.what) from None
    flag = "--from-network" if authored.network else "--from"
    found = [
        existing_source(f"{where} -> source {number}", file.absolute().parent / source, instead)
        for number, (source, instead) in enumerate(zip(recipe.sources, ("FACE", flag), strict=False), 1)
    ]
    return SliderRecipe(
        face=found[0],
        table=found[1] if count == 2 and not authored.network else None,
        network=found[1] if authored.network else None,
        settings=settings,
        shapes=shapes,
        drop=authored.drop,
        standalone=standalone,
        warnings=changed_sources(file, zip(found, recipe.digests, strict=True)),
    )


def _settings(where: str, options: Mapping[str, object]) -> SetSliders:
    keys = {"values": dict, "mirror": bool, "reset": bool, "name": str}
    if not isinstance(options, Mapping) or set(options) != set(keys):
        raise SchemaError(where, f"options are damaged, expected an object of {', '.join(keys)}")
    wrong = [key for key, kind in keys.items() if type(options[key]) is not kind]
    values = options["values"]
    if wrong or not isinstance(values, dict) or not all(type(one) in (int, float) for one in values.values()):
        raise SchemaError(f"{where} -> {(*wrong, 'values')[0]}", "damaged, expected as `facepipe sliders` wrote it")
    return SetSliders(
        values={str(name): float(one) for name, one in values.items()},
        mirror=options["mirror"] is True,
        reset=options["reset"] is True,
        name=str(options["name"]),
    )
