"""Faces of other formats: the kinds that are read here, and those of plug-ins."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from facepipe import registry
from facepipe.core.errors import InputError
from facepipe.importers.options import OPTIONS

if TYPE_CHECKING:
    from facepipe.registry import Importer
    from facepipe.stage import Face
    from facepipe.stage.recipes import Imported


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


def kind_of(path: str | Path) -> str:
    """The kind of a file, by its suffix.

    :raises InputError: no importer reads such files, or several may
    """
    suffix = Path(path).suffix.lower()
    known = {".fbx": "fbx", ".obj": "obj"}
    for kind in registry.importers():
        known |= dict.fromkeys(getattr(importer(kind), "SUFFIXES", ()), kind)
    if suffix not in known:
        expected = f"expected .usda .usdc .usd .usdz {' '.join(sorted(known))} (`facepipe import` reads more)"
        raise InputError(path, f"suffix '{suffix[:20]}', {expected}")
    return known[suffix]


def contents_of(path: str | Path) -> dict[str, Any] | None:
    """Counts and bytes of what is in a file; None of a stage, and of files whose importer doesn't say.

    :raises InputError: no such file, one that can't be read, or no importer for it
    """
    from facepipe.stage.files import SUFFIXES

    if Path(path).suffix.lower() in SUFFIXES:
        return None
    contents = getattr(importer(kind_of(path)), "contents", None)
    return None if contents is None else contents(Path(path))


def read_face(path: str | Path, kind: str | None = None, options: object | None = None) -> Face:
    """The face of any file: opened where it is USD, else imported into memory.

    :param kind: of the importer; None: by the suffix
    :param options: an instance of the importer's `Options`; None: its defaults
    :raises InputError: no such file, one that can't be read, or no importer for it
    :raises SchemaError, TopologyError: a stage without a face, or meshes and shapes that don't fit each other
    """
    from facepipe.stage import Face, open_face
    from facepipe.stage.files import SUFFIXES

    if kind is None and Path(path).suffix.lower() in SUFFIXES:
        return open_face(path)
    imported = load(kind_of(path) if kind is None else kind, path, options)
    face = Face.from_parts(imported.parts)
    face.file, face.warnings = Path(path), imported.warnings
    return face
