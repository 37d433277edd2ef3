"""Faces of other formats: the kinds that are read here, and those of plug-ins."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from facepipe import registry
from facepipe.importers.options import OPTIONS

if TYPE_CHECKING:
    from facepipe.registry import Importer
    from facepipe.stage.imported import Imported


def kinds() -> tuple[str, ...]:
    """The kinds of files and folders that some importer reads, sorted."""
    return tuple(sorted({*OPTIONS, *registry.importers()}))


def options_of(kind: str) -> Any:
    """The `Options` of a kind; for those of this folder without the modules that read it.

    :raises InputError: no such kind
    """
    return OPTIONS[kind] if kind in OPTIONS else importer(kind).Options


def importer(kind: str) -> Importer:
    """The module that reads `kind`.

    :raises InputError: no such kind
    """
    if kind not in OPTIONS:
        return registry.importer(kind, OPTIONS)
    return cast("Importer", importlib.import_module(f"facepipe.importers.{kind}"))


def load(kind: str, source: str | Path, options: object | None = None) -> Imported:
    """Read the face at `source`.

    :param options: an instance of the importer's `Options`; None: its defaults
    :raises InputError: unknown kind, or a source or option that can't be used
    :raises TopologyError: meshes and shapes that don't fit each other
    """
    module = importer(kind)
    return module.read(Path(source), module.Options() if options is None else options)
