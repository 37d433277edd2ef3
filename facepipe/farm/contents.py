"""What files hold: digests of them with all that they stand on, found once until one of them changes."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from facepipe.core.digests import digest
from facepipe.core.errors import InputError
from facepipe.core.reading import read_json_object
from facepipe.stage.files import SUFFIXES, dependencies

_MOST_BYTES = 1 << 28  # of a glTF document
State = tuple[int, int]  # bytes, nanoseconds of the last change


class Content(NamedTuple):
    """A file or folder as it was read."""

    digest: str
    states: dict[str, State]  # of each file that it stands on


def state_of(path: str | os.PathLike[str]) -> State | None:
    """What tells without reading whether a file is another than before; None where there is none."""
    try:
        found = Path(path).stat()
    except (OSError, ValueError):
        return None
    return found.st_size, found.st_mtime_ns


def unchanged(states: dict[str, Sequence[int]]) -> bool:
    """Whether files, path -> state, are as they were."""
    return all(state_of(path) == tuple(state) for path, state in states.items())


class Contents:
    """Contents by path."""

    def __init__(self) -> None:
        self._known: dict[Path, Content] = {}

    def of(self, path: Path) -> Content:
        """:raises InputError: it can't be read, or changes while it is read"""
        known = self._known.get(path)
        if known is None or not unchanged(dict(known.states)):
            known = self._known[path] = _read(path)
        return known


def _read(path: Path) -> Content:
    files = sorted(stands_on(path))
    before = {str(one): state_of(one) for one in files}
    found = digest(files)
    states = {one: state for one, state in before.items() if state is not None and state == state_of(one)}
    if len(states) != len(files):
        raise InputError(path, "changes while it is read, expected it to rest")
    return Content(found, states)


def stands_on(path: Path) -> set[Path]:
    """A file with the layers, textures and buffers that it names; all files of a folder.

    :raises InputError: there is none, or it is damaged
    """
    if path.is_dir():
        return {one for one in path.rglob("*") if one.is_file()}
    if not path.is_file():
        raise InputError(path, "no such file")
    suffix = path.suffix.lower()
    if suffix in SUFFIXES:
        return {_shortest(one) for one in dependencies(path) if one.is_file()} | {path}
    if suffix == ".gltf":
        return {path, *(one for one in _named(path) if one.is_file())}
    return {path}


def _shortest(path: Path) -> Path:
    """As seen from the working folder, where it is below that: what is kept of it is the same on every machine."""
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path


def _named(path: Path) -> Iterable[Path]:
    """Files of the buffers and images of a glTF."""
    from urllib.parse import unquote

    document = read_json_object(path, _MOST_BYTES)
    for key in ("buffers", "images"):
        entries = document.get(key)
        for one in entries if isinstance(entries, list) else ():
            uri = one.get("uri") if isinstance(one, dict) else None
            if isinstance(uri, str) and not uri.startswith("data:"):
                yield path.parent / unquote(uri)
