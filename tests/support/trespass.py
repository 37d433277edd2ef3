"""What this process opens, lists, makes or connects to where it should not: by an audit hook."""

from __future__ import annotations

import functools
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_CONNECTIONS = ("socket.connect", "socket.getaddrinfo", "socket.gethostbyname", "socket.sendto", "urllib.Request")
_PATHS = ("open", "os.listdir", "os.scandir", "os.mkdir", "os.remove", "os.rename", "os.link", "os.symlink", "os.chmod")
_PATHS += ("os.truncate", "os.rmdir", "os.utime", "shutil.rmtree", "shutil.copyfile", "shutil.move", "glob.glob")
_OF_LINKS = ("os.remove", "os.rename", "os.symlink", "os.link", "shutil.rmtree")  # not of what they lead to
_found: list[str] = []
_closed: list[str] = []  # folders and files that are of no concern


@contextmanager
def trespassing(*closed: Path) -> Iterator[list[str]]:
    """A list of what is done in the block, in this process, below `closed` paths or with other machines."""
    _hook()
    _found.clear()
    _closed[:] = map(os.path.realpath, closed)
    try:
        yield _found
    finally:
        _closed.clear()


@functools.cache
def _hook() -> None:
    sys.addaudithook(_on_event)  # for good: hooks can't be taken back


def _on_event(event: str, arguments: tuple[object, ...]) -> None:
    if not _closed:
        return
    if event in _CONNECTIONS:
        _found.append(f"{event} {arguments}")
    elif event in _PATHS:
        _found.extend(f"{event} {path}" for path in map(_meant, *_asked(event, arguments)) if _is_closed(path))


def _asked(event: str, arguments: tuple[object, ...]) -> tuple[list[str], list[bool]]:
    """Paths, and whether links that they end with are followed."""
    paths = [os.fsdecode(one) for one in arguments[:2] if isinstance(one, str | bytes | os.PathLike)]
    follows = event not in _OF_LINKS
    if event == "open":
        paths, flags = paths[:1], arguments[2]
        follows = not (isinstance(flags, int) and flags & getattr(os, "O_NOFOLLOW", 0))
    return paths, [follows] * len(paths)


def _meant(path: str, follows: bool) -> str:
    folder, name = os.path.split(path)
    return os.path.realpath(path) if follows else f"{os.path.realpath(folder)}{os.sep}{name}"


def _is_closed(path: str) -> bool:
    return any(path == one or path.startswith(f"{one}{os.sep}") for one in _closed)
