"""Stages of a rebuild: their recipes read back, and what there is to tell of one that was made."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

from facepipe.core.errors import SchemaError
from facepipe.core.reports import Report
from facepipe.declare import from_json
from facepipe.stage.recipes import existing_source, recipe_of

Told = TypeVar("Told", bound=Report)
Options = TypeVar("Options")


class Made(NamedTuple, Generic[Told]):
    """A stage that is saved."""

    report: Told  # its warnings are all that there are
    missed: tuple[str, ...]  # a line for each limit


@dataclass(frozen=True, kw_only=True)
class StageRecipe:
    """What `stage_recipe` wrote."""

    where: str  # the trail to it, for messages
    content: Mapping[str, Any]
    standalone: bool
    _found: Mapping[str, Path]  # source -> file

    def file(self, what: str) -> Path:
        """:raises SchemaError: the recipe names no such file"""
        found = self.optional(what)
        if found is None:
            raise SchemaError(f"{self.where} -> files", f"no {what}, expected one")
        return found

    def optional(self, what: str) -> Path | None:
        """The same; None where the recipe names none."""
        name = self._files.get(what)
        return None if name is None else self._path(what, name)

    def several(self, what: str) -> list[Path]:
        """Files under one name, in their order.

        :raises SchemaError: no list of them
        """
        names = self._files.get(what)
        if not isinstance(names, list) or not names:
            raise SchemaError(f"{self.where} -> files -> {what}", "damaged, expected a list of files")
        return [self._path(what, name) for name in names]

    def options(self, kind: type[Options]) -> Options:
        """:raises InputError: options that `kind` has not, or of another type or out of range"""
        return from_json(kind, self.content.get("options"), f"{self.where} -> options")  # type: ignore[type-var]

    def weights(self, key: str) -> dict[str, float]:
        """Shape -> weight; empty where the recipe has none.

        :raises SchemaError: no weights
        """
        values = self.content.get(key, {})
        fits = isinstance(values, Mapping) and all(
            type(one) in (int, float) and abs(one) < 1e300 for one in values.values()
        )
        if not fits:
            raise SchemaError(f"{self.where} -> {key}", f"{str(values)[:40]}, expected a number for each shape")
        return {str(name): float(one) for name, one in values.items()}

    @property
    def _files(self) -> Mapping[str, Any]:
        files = self.content.get("files")
        if not isinstance(files, Mapping):
            raise SchemaError(f"{self.where} -> files", "damaged, expected an object of files")
        return files

    def _path(self, what: str, name: object) -> Path:
        if not isinstance(name, str) or name not in self._found:
            raise SchemaError(f"{self.where} -> files -> {what}", f"{str(name)[:60]}, expected one of the sources")
        return self._found[name]


def read_stage_recipe(path: Path, verb: str) -> StageRecipe:
    """The recipe on a stage that `facepipe VERB` made; its other layers may be lost.

    :raises InputError: a recipe of another verb, or a source that is not where it was
    :raises SchemaError: a damaged recipe, or one of a newer facepipe
    """
    recipe, standalone = recipe_of(path, verb)
    where, folder = f"{path} -> recipe", path.absolute().parent
    if not isinstance(recipe.options, Mapping):
        raise SchemaError(where, "options are damaged, expected an object")
    found = {
        source: existing_source(f"{where} -> source {number}", folder / source, "the command's argument")
        for number, source in enumerate(recipe.sources, 1)
    }
    return StageRecipe(where=where, content=recipe.options, standalone=standalone, _found=found)
