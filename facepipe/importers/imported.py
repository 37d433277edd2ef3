"""What every importer returns, and the recipe that it leaves on the face."""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facepipe import __version__
from facepipe.errors import InputError
from facepipe.parts import FaceParts, Recipe

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


@dataclass(frozen=True, kw_only=True)
class Imported:
    """A face read from a source file, and what the user should know about it (one line each)."""

    parts: FaceParts
    warnings: tuple[str, ...] = ()


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
        options={field.name: json_value(getattr(options, field.name)) for field in dataclasses.fields(options)},
        version=__version__,
    )


def digest(files: Iterable[Path]) -> str:
    """``sha256:...`` of one file's bytes, or, for several, of their sorted lines ``<sha256>  <file name>``."""
    sums = sorted((path.name, _sha256(path)) for path in files)
    if len(sums) == 1:
        return f"sha256:{sums[0][1]}"
    listing = "".join(f"{value}  {name}\n" for name, value in sums)
    return f"sha256:{hashlib.sha256(listing.encode()).hexdigest()}"


def json_value(value: object) -> Any:
    """`value` as JSON holds it: paths become strings, tuples lists, mappings dictionaries with sorted keys."""
    if isinstance(value, Path):
        return value.as_posix()
    if isinstance(value, Mapping):
        return {str(key): json_value(value[key]) for key in sorted(value)}
    if isinstance(value, list | tuple):
        return [json_value(item) for item in value]
    return value


def check_ranges(options: DataclassInstance) -> None:
    """Check every number in `options` against its field's ``metadata["range"]``, a pair (lowest, highest).

    :raises InputError: an option is out of range or not finite
    """
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        if "range" not in field.metadata or value is None:
            continue
        low, high = field.metadata["range"]
        if not (isinstance(value, int | float) and math.isfinite(value) and low <= value <= high):
            raise InputError(f"option {field.name}", f"is {value!r}, expected a number from {low:g} to {high:g}")


def _sha256(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(path, f"can't be read: {error.strerror or error}") from error
