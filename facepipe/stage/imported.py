"""What every importer returns, and the recipe that it leaves on the face."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from facepipe.core import __version__
from facepipe.core.reading import digest
from facepipe.declare import to_json
from facepipe.parts import FaceParts, Recipe

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


@dataclass(frozen=True, kw_only=True)
class Imported:
    """A face read from a source file, and what the user should know about it (one line each)."""

    parts: FaceParts
    warnings: tuple[str, ...] = ()


def with_units(parts: FaceParts, meters_per_unit: float | None, up_axis: Literal["Y", "Z"] | None) -> FaceParts:
    """The face with a unit and an up axis in place of those of its file; None keeps the file's."""
    return replace(parts, meters_per_unit=meters_per_unit or parts.meters_per_unit, up_axis=up_axis or parts.up_axis)


def import_recipe(kind: str, files: Mapping[Path, Iterable[Path]], options: DataclassInstance) -> Recipe:
    """The recipe of an import of `kind`.

    :param files: each source as the user gave it -> the files of it that were read (itself, or some of a folder)
    :param options: the importer's options
    :raises InputError: a file can't be read
    """
    return Recipe(
        verb=f"import {kind}",
        sources=tuple(source.as_posix() for source in files),
        digests=tuple(digest(read) for read in files.values()),
        options=to_json(options),
        version=__version__,
    )
