"""Readers of other formats: kind -> module with a frozen `Options` dataclass and ``read(source, options) -> Imported``.

An option's field metadata holds ``help``, and where they apply ``range`` (lowest, highest), ``unit``, and ``parse``
(a function from the text a user types to the option's value).
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facepipe.errors import InputError

if TYPE_CHECKING:
    from facepipe.importers.imported import Imported

IMPORTERS: dict[str, str] = {
    "ict": "facepipe.importers.ict",
    "makehuman": "facepipe.importers.makehuman",
    "obj": "facepipe.importers.obj",
    "gltf": "facepipe.importers.gltf",
    "usd": "facepipe.importers.usd",
}


def importer(kind: str) -> Any:
    """The module that reads `kind`.

    :raises InputError: no such kind
    """
    if kind not in IMPORTERS:
        raise InputError(f"import {kind}", f"unknown kind, expected one of {', '.join(sorted(IMPORTERS))}")
    return importlib.import_module(IMPORTERS[kind])


def load(kind: str, source: str | Path, options: object | None = None) -> Imported:
    """Read the face at `source`.

    :param options: an instance of the importer's `Options`; None: its defaults
    :raises InputError: unknown kind, or a source or option that can't be used
    :raises TopologyError: meshes and shapes that don't fit each other
    """
    module = importer(kind)
    imported: Imported = module.read(Path(source), module.Options() if options is None else options)
    return imported
