"""Readers of other formats: kind -> module with an `Options` dataclass and ``read(source, options) -> Imported``."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facepipe.core.errors import InputError
from facepipe.importers.options import OPTIONS

if TYPE_CHECKING:
    from facepipe.importers.imported import Imported


def importer(kind: str) -> Any:
    """The module that reads `kind`.

    :raises InputError: no such kind
    """
    if kind not in OPTIONS:
        raise InputError(f"import {kind}", f"unknown kind, expected one of {', '.join(sorted(OPTIONS))}")
    return importlib.import_module(f"facepipe.importers.{kind}")


def load(kind: str, source: str | Path, options: object | None = None) -> Imported:
    """Read the face at `source`.

    :param options: an instance of the importer's `Options`; None: its defaults
    :raises InputError: unknown kind, or a source or option that can't be used
    :raises TopologyError: meshes and shapes that don't fit each other
    """
    module = importer(kind)
    imported: Imported = module.read(Path(source), module.Options() if options is None else options)
    return imported
