"""Digests of files with all that they stand on, computed once until one changes; results kept by their keys.

Results are kept up to a size: those used longest ago go first.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import secrets
import shutil
import stat
from collections.abc import Callable, Iterable, Mapping, Sequence
from io import BufferedReader
from pathlib import Path
from typing import Any, NamedTuple

from facepipe.core.atomic import replacing, together
from facepipe.core.errors import ChangedError, FacepipeError, InputError, system_errors
from facepipe.core.policy.paths import check_readable, check_written, is_writable, trust
from facepipe.core.reading import digest, read_bytes, read_json_object
from facepipe.importers.wavefront import texture_name
from facepipe.stage.files import SUFFIXES, dependencies, named_in
from facepipe.tasks.ledger import is_outcome, parsed

_RECORD = "record.json"
_PASSING = ".new-"
_ENTRY = re.compile(rf"[0-9a-f]{{64}}|{re.escape(_PASSING)}[0-9a-f]{{16}}")
_MOST_RECORD = 1 << 22  # bytes; a longer one is cut off, and damaged
_BETWEEN = 0.01  # of its size: what a process may add before it measures the folder again
_unseen: dict[Path, int] = {}  # folder -> bytes that this process has added since it measured
_MOST_BYTES = 1 << 28  # of a glTF document
_MOST_TEXT = 1 << 30  # of an OBJ file
_MTLLIB = re.compile(r"^[ \t]*mtllib[ \t]+([^#\r\n]+)", re.MULTILINE)
_MAP_KD = re.compile(r"^[ \t]*map_Kd[ \t]+([^\r\n]+)", re.MULTILINE)
State = tuple[int, int]  # bytes, nanoseconds of the last change


class Cache:
    """A folder that several processes and plans share; what is in it can be removed at any time."""

    def __init__(self, folder: Path, most_bytes: int, place: Callable[[str], Path] = Path) -> None:
        """
        :param place: the path of a file that a record names
        :raises InputError: the folder can't be made, or is a link that leads out of the roots
        """
        check_written(folder)
        self._folder, self._most, self._place = folder, most_bytes, place
        with system_errors(folder, "can't be made"):
            folder.mkdir(parents=True, exist_ok=True)

    def fetch(self, key: str, is_own: Callable[[Path], bool]) -> dict[str, Any] | None:
        """Put the files of a key in their places: the record that was kept; None where it isn't here, or is damaged.

        :param is_own: whether a path is of the results that are asked for: the folder may be of others
        """
        entry = self._folder / key
        try:
            if entry.is_symlink():
                raise InputError(entry, "is a link, expected a folder")
            with _opened(entry / _RECORD) as file:
                record = parsed(file.read(_MOST_RECORD))
            if not is_outcome(record) or not record.get("writes"):
                raise InputError(entry / _RECORD, "is damaged")
            writes = [(self._place(name), own) for name, (_, own) in record["writes"].items()]
            for path, _ in writes:
                if ".." in path.parts or not is_own(path):
                    raise InputError(entry, f"is of {path}, expected the results of the task")
                if not is_writable(path, trust().roots):
                    raise InputError(entry, "is of files outside the roots")
            if sum((entry / str(number)).lstat().st_size for number in range(len(writes))) > self._most:
                raise InputError(entry, "is larger than the cache")
            if any(_digest(entry / str(number)) != own for number, (_, own) in enumerate(writes)):
                raise InputError(entry, "is damaged")
        except (OSError, ValueError, FacepipeError):
            _remove(entry)
            return None
        with together(writes[0][0]) if writes else contextlib.nullcontext():
            for number, (path, _) in enumerate(writes):
                path.parent.mkdir(parents=True, exist_ok=True)
                with replacing(path) as temporary:
                    shutil.copyfile(entry / str(number), temporary)
        os.utime(entry)
        return dict(record)

    def keep(self, key: str, record: Mapping[str, Any]) -> None:
        """Keep a result; where there is no room for it on the disk, it is not kept."""
        passing = self._folder / f"{_PASSING}{secrets.token_hex(8)}"
        try:
            passing.mkdir()
            for number, name in enumerate(record["writes"]):
                shutil.copyfile(self._place(name), passing / str(number))
            (passing / _RECORD).write_text(json.dumps(record), encoding="utf-8")
            fresh = sum(path.stat().st_size for path in passing.iterdir())
            passing.rename(self._folder / key)
        except OSError:  # a full disk, or another process has kept the same
            shutil.rmtree(passing, ignore_errors=True)
            fresh = 0
        seen = self._folder in _unseen
        _unseen[self._folder] = _unseen.get(self._folder, 0) + fresh
        if not seen or _unseen[self._folder] > _BETWEEN * self._most:
            _unseen[self._folder] = 0
            self._evict()

    def _evict(self) -> None:
        entries = []
        for entry in self._folder.iterdir():
            if not _ENTRY.fullmatch(entry.name) or entry.is_symlink():  # the caller's, who had the folder before
                continue
            with contextlib.suppress(OSError):
                used = sum(path.stat().st_size for path in entry.iterdir())
                entries.append((entry.stat().st_mtime_ns, used, entry))
        over = sum(used for _, used, _ in entries) - self._most
        for _, used, entry in sorted(entries):
            if over <= 0:
                return
            _remove(entry)
            over -= used


def _remove(entry: Path) -> None:
    """Remove an entry, or what is in its place: `shutil.rmtree` opens a pipe to see what it is, and waits for ever."""
    with contextlib.suppress(OSError):
        if stat.S_ISDIR(entry.lstat().st_mode):
            shutil.rmtree(entry, ignore_errors=True)
        else:
            entry.unlink()


def _opened(path: Path) -> BufferedReader:
    """:raises InputError: it is a link, a pipe, or a device"""
    if not stat.S_ISREG(path.lstat().st_mode):
        raise InputError(path, "is not a regular file")
    return path.open("rb")


def _digest(path: Path) -> str:
    """As `facepipe.core.reading.digest`."""
    with _opened(path) as file:
        return f"sha256:{hashlib.file_digest(file, 'sha256').hexdigest()}"


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
        from urllib.parse import unquote

        document = read_json_object(path, _MOST_BYTES)
        lists = [one for one in (document.get("buffers"), document.get("images")) if isinstance(one, list)]
        uris = [one.get("uri") for entries in lists for one in entries if isinstance(one, dict)]
        names = [unquote(uri) for uri in uris if isinstance(uri, str) and not uri.startswith("data:")]
    elif suffix == ".fbx":
        from facepipe.importers.fbx.materials import picture_names

        names = picture_names(path)
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
