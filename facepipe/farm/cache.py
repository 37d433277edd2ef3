"""Results kept by their keys, up to a size: those used longest ago go first."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import secrets
import shutil
import stat
from collections.abc import Callable, Mapping
from io import BufferedReader
from pathlib import Path
from typing import Any

from facepipe.core.atomic import replacing, together
from facepipe.core.errors import FacepipeError, InputError, system_errors
from facepipe.core.policy.paths import check_written, is_writable, trust
from facepipe.farm.ledger import is_outcome, parsed

_RECORD = "record.json"
_PASSING = ".new-"
_ENTRY = re.compile(rf"[0-9a-f]{{64}}|{re.escape(_PASSING)}[0-9a-f]{{16}}")
_MOST_RECORD = 1 << 22  # bytes; a longer one is cut off, and damaged
_BETWEEN = 0.01  # of its size: what a process may add before it measures the folder again
_unseen: dict[Path, int] = {}  # folder -> bytes that this process has added since it measured


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
