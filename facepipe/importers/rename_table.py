"""Other names of shapes and joints: a convention's, or a table's: JSON ``{"old": "new"}``, CSV of old and new."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.core.errors import InputError
from facepipe.core.names import did_you_mean, first_names
from facepipe.core.reading import read_bytes, read_json_object
from facepipe.rig.conventions import CONVENTIONS

if TYPE_CHECKING:
    from facepipe.parts import FaceParts

MAX_BYTES = 1 << 24
_HEADER = ("old", "new")


@dataclass(frozen=True, kw_only=True)
class Renamed:
    """A face under its new names, which its recipe holds where it was imported."""

    parts: FaceParts
    names: Mapping[str, str]  # old -> new, of those that changed
    warnings: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Rename:
    """What `--rename` asks for: the names of a convention, or of a table."""

    given: str
    table: Mapping[str, str] | None  # None: a convention

    def __call__(self, parts: FaceParts) -> Renamed:
        """The face under its new names.

        :raises InputError: names that collide
        """
        from facepipe.rig.conventions import convention_names, renamed, shapes_of, unknown_names, unnamed

        shapes, meshes, where = parts.shapes, shapes_of(parts.meshes), f"--rename {self.given}"
        warnings = []
        if self.table is None:
            names: Mapping[str, str] = convention_names(self.given, shapes, meshes)
            if kept := unnamed(self.given, shapes, meshes):
                some = first_names(kept, 3)
                warnings = [f"{len(kept)} shapes keep their names ({some}): others mean the same"]
                if len(kept) == 1:
                    warnings = [f"1 shape keeps its name ({some}): another means the same"]
        else:
            names, missing = self.table, unknown_names(parts, self.table)
            warnings = [missing] if missing else []
        result = renamed(parts, names, where)
        before, after = parts.skeleton.names, result.skeleton.names
        changed = {shape: names[shape] for shape in shapes if names.get(shape, shape) != shape}
        changed |= {old: new for old, new in zip(before, after, strict=True) if old != new}
        if result.recipe is not None and result.recipe.verb.startswith("import "):
            options = {**result.recipe.options, "rename": changed}
            result = replace(result, recipe=replace(result.recipe, options=options))
        return Renamed(parts=result, names=changed, warnings=tuple(f"{where}: {one}" for one in warnings))


def rename_of(given: str) -> Rename:
    """What `--rename` asks for.

    :raises InputError: neither a convention nor a table, or a damaged table
    """
    if given.lower() in CONVENTIONS:
        return Rename(given=given.lower(), table=None)
    if not Path(given).suffix:
        near = did_you_mean(given, CONVENTIONS) or f", expected one of {' '.join(CONVENTIONS)}"
        raise InputError(f"--rename {given}", f"no convention{near}")
    path = Path(given)
    rows: list[tuple[str, object, str]] = []
    if path.suffix.lower() == ".json":
        rows = [(old, new, f"'{old[:60]}'") for old, new in read_json_object(path, MAX_BYTES).items()]
    elif path.suffix.lower() == ".csv":
        try:
            text = read_bytes(path, MAX_BYTES).decode("utf-8-sig")
            lines = list(csv.reader(io.StringIO(text, newline=""), strict=True))
        except (UnicodeDecodeError, csv.Error) as error:
            raise InputError(path, f"no CSV in UTF-8 ({error}), expected two columns, old and new") from None
        for number, row in enumerate(lines, 1):
            if len(row) != 2 and row:
                raise InputError(f"{path} -> row {number}", f"{len(row)} columns, expected two: old,new")
            if row and not (number == 1 and tuple(one.strip().lower() for one in row) == _HEADER):
                rows.append((row[0], row[1], f"row {number}"))
    else:
        raise InputError(path, f"suffix '{path.suffix}', expected .json or .csv with old and new names")
    names: dict[str, str] = {}
    owners: dict[str, str] = {}
    for old, new, at in rows:
        where = f"{path} -> {at}"
        if not isinstance(new, str) or not old or not new or "\0" in old + new:
            raise InputError(where, "no pair of names, expected two texts that are not empty")
        if old in names:
            raise InputError(where, f"'{old[:60]}' once more, expected each old name once")
        if new in owners:
            raise InputError(where, f"'{new[:60]}' is the new name of '{owners[new][:60]}' too, expected two names")
        names[old] = new
        owners[new] = old
    if not names:
        raise InputError(path, "no names, expected pairs of old and new")
    return Rename(given=given, table=names)
