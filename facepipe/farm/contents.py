"""Digests of files with all that they stand on, computed once until one of these changes."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from facepipe.core.errors import ChangedError, InputError
from facepipe.core.policy.paths import check_readable
from facepipe.core.reading import digest, read_bytes, read_json_object
from facepipe.importers.wavefront import texture_name
from facepipe.stage.files import SUFFIXES, dependencies, named_in

_MOST_BYTES = 1 << 28  # of a glTF document
_MOST_TEXT = 1 << 30  # of an OBJ file
_MTLLIB = re.compile(r"^[ \t]*mtllib[ \t]+([^#\r\n]+)", re.MULTILINE)
_MAP_KD = re.compile(r"^[ \t]*map_Kd[ \t]+([^\r\n]+)", re.MULTILINE)
State = tuple[int, int]  # bytes, nanoseconds of the last change


class Content(NamedTuple):
    """A file or folder as it was read."""

    digest: str
    states: dict[str, State]  # of each file that it stands on


def state_of(path: str | os.PathLike[str]) -> State | None:
    """A mark of a file that changes with it, found without reading it; None where there is no file."""
    try:
        status = Path(path).stat()
    except (OSError, ValueError):
        return None
    return status.st_size, status.st_mtime_ns


def unchanged(states: dict[str, Sequence[int]]) -> bool:
    """Whether files, path -> state, are as they were."""
    return all(state_of(path) == tuple(state) for path, state in states.items())


class Contents:
    """Contents by path."""

    def __init__(self) -> None:
        self._known: dict[Path, Content] = {}

    def content_of(self, path: Path) -> Content:
        """:raises InputError: it can't be read, or changes while it is read"""
        known = self._known.get(path)
        if known is None or not unchanged(dict(known.states)):
            files = sorted(_stands_on(path))
            before = {str(file): state_of(file) for file in files}
            content = digest(files)
            states = {one: state for one, state in before.items() if state is not None and state == state_of(one)}
            if len(states) != len(files):
                raise ChangedError(path, "changes while it is read, expected a file that nobody writes")
            known = self._known[path] = Content(content, states)
        return known


def _stands_on(path: Path) -> set[Path]:
    """A file with the layers, textures and buffers that it names; all files of a folder.

    :raises InputError: there is none, it is damaged, or one may not be read
    """
    check_readable(path)  # before a folder is listed: it may be the whole disk
    if path.is_dir():
        return {one for one in path.rglob("*") if one.is_file()}
    if not path.is_file():
        raise InputError(path, "no such file")
    if path.suffix.lower() in SUFFIXES:
        return {
            (dependency.relative_to(Path.cwd()) if dependency.is_relative_to(Path.cwd()) else dependency)
            for dependency in dependencies(path)
            if dependency.is_file()
        } | {path}
    reached, todo = {path}, [path]
    while todo:
        others = named(todo.pop())
        for one in others:
            check_readable(one)
        fresh = {one for one in others if one.is_file()} - reached
        reached |= fresh
        todo += fresh
    return reached


def named(path: Path) -> set[Path]:
    """The files that a file itself names, there or not: layers, textures, buffers, libraries of materials.

    :raises InputError: it is damaged
    """
    suffix = path.suffix.lower()
    if suffix in SUFFIXES:
        names: Iterable[str] = named_in(path) if suffix != ".usdz" else ()
    elif suffix == ".gltf":
        names = _uris(path)
    elif suffix == ".obj":
        names = _MTLLIB.findall(_text(path))
    elif suffix == ".mtl":
        names = map(texture_name, _MAP_KD.findall(_text(path)))
    else:
        names = ()
    return {
        Path(os.path.normpath(path.parent / name.strip().replace("\\", "/"))) for name in names if "://" not in name
    }


def _text(path: Path) -> str:
    return read_bytes(path, _MOST_TEXT).decode("utf-8", "replace")


def _uris(path: Path) -> Iterable[str]:
    """Names of the buffers and images of a glTF."""
    from urllib.parse import unquote

    document = read_json_object(path, _MOST_BYTES)
    for key in ("buffers", "images"):
        entries = document.get(key)
        for one in entries if isinstance(entries, list) else ():
            uri = one.get("uri") if isinstance(one, dict) else None
            if isinstance(uri, str) and not uri.startswith("data:"):
                yield unquote(uri)
