"""Exporters by file suffix and hosts by name, found through entry points.

An exporter (``facepipe.exporters``) is a module with a frozen dataclass ``Options``, ``export(face, path, options) ->
ExportReport`` and ``validate(path) -> sequence of Finding``. A host (``facepipe.hosts``) is a module that brings faces
into another program; its command says what it calls there.
"""

from __future__ import annotations

from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from facepipe.core.errors import InputError

GROUP = "facepipe.exporters"
HOSTS = "facepipe.hosts"


def suffixes() -> tuple[str, ...]:
    """The suffixes some exporter writes, without dot, sorted."""
    return tuple(sorted({entry.name for entry in entry_points(group=GROUP)}))


def exporter(path: str | Path) -> Any:
    """The exporter module of a path, by its suffix.

    :raises InputError: no exporter for the suffix
    """
    suffix = Path(path).suffix.lower().removeprefix(".")
    for entry in entry_points(group=GROUP):
        if entry.name == suffix:
            return entry.load()
    expected = " ".join(f".{one}" for one in suffixes())
    raise InputError(path, f"suffix '.{suffix}', expected one of {expected}")


def host(name: str) -> Any:
    """The host module that is called `name`.

    :raises InputError: it is not installed
    """
    for entry in entry_points(group=HOSTS, name=name):
        return entry.load()
    raise InputError(f"facepipe {name}", "is not part of this installation, expected facepipe installed anew")
