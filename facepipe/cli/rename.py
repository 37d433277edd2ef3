"""`--rename`: a convention's names, or those of a table, on import and export."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.cli.show import note, warn
from facepipe.core.errors import InputError
from facepipe.rig.conventions import CONVENTIONS

if TYPE_CHECKING:
    from facepipe.parts import FaceParts


@dataclass(frozen=True)
class Rename:
    """What `--rename` asks for: the names of a convention, or of a table."""

    given: str
    table: Mapping[str, str] | None  # None: a convention

    def __call__(self, parts: FaceParts) -> FaceParts:
        """The face under its new names, which its recipe holds; says what was renamed.

        :raises InputError: names that collide
        """
        from facepipe.rig.rename import convention_names, renamed, shapes_of, unknown_names

        shapes = shapes_of(parts)
        names = dict(convention_names(self.given, shapes) if self.table is None else self.table)
        result = renamed(parts, names, f"--rename {self.given}")
        missing = None if self.table is None else unknown_names(parts, names)
        if missing is not None:
            warn([f"--rename {self.given}: {missing}"])
        before, after = (*shapes, *parts.skeleton.names), (*shapes_of(result), *result.skeleton.names)
        changed = [(old, new) for old, new in zip(before, after, strict=True) if old != new]
        like = f", like '{changed[0][0]}' to '{changed[0][1]}'" if changed else ""
        note(f"--rename {self.given}: {len(changed)} names changed{like}")
        if result.recipe is None or not result.recipe.verb.startswith("import "):
            return result
        options = {**result.recipe.options, "rename": dict(changed)}
        return replace(result, recipe=replace(result.recipe, options=options))


def add_rename(parser: argparse.ArgumentParser) -> None:
    """`--rename NAMES|FILE`."""
    kinds = " ".join(CONVENTIONS)
    parser.add_argument(
        "--rename",
        metavar="NAMES",
        help=f"other names of shapes, in clips and sliders too: {kinds}; or a table of shapes and joints, a .json "
        "({old: new}) or .csv (old,new)",
    )


def rename_of(arguments: argparse.Namespace) -> Rename | None:
    """What `--rename` asks for.

    :raises InputError: neither a convention nor a table, or a damaged table
    """
    given: str | None = arguments.rename
    if given is None:
        return None
    if given.lower() in CONVENTIONS:
        return Rename(given.lower(), None)
    from facepipe.core.names import did_you_mean
    from facepipe.importers.rename_table import read_rename_table

    if not Path(given).suffix:
        near = did_you_mean(given, CONVENTIONS)
        raise InputError(
            f"--rename {given}", f"no convention{near or f', expected one of {chr(32).join(CONVENTIONS)}'}"
        )
    return Rename(given, read_rename_table(Path(given)))
