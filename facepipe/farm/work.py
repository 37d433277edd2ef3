"""A task, in the process that does it: its result is made, kept, or taken from a cache.

The key is a digest of the line, of all that it reads, and of the version: tasks of one key have the same results.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from facepipe.core import __version__
from facepipe.core.errors import ChangedError, FacepipeError, InputError, printable
from facepipe.core.locks import locked
from facepipe.core.policy.paths import is_url, is_writable, trust
from facepipe.core.reading import digest
from facepipe.farm.cache import Cache
from facepipe.farm.contents import Contents, named
from facepipe.farm.ledger import CACHED, FAILED, KEPT, MADE, Record
from facepipe.farm.mirror import Mirror
from facepipe.farm.remote import StoreError
from facepipe.stage.files import SUFFIXES
from facepipe.stage.recipes import attribution_of
from facepipe.stage.textures import texture_folder

_MOST = 40  # entries of a list or mapping in a report that is kept
_PASSING = {errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.ENOMEM, errno.ESTALE, errno.EMFILE, errno.ENFILE, errno.EROFS}


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """The outcome of a line."""

    missed: bool = False  # a check or threshold
    report: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Line:
    """A line of the command line, read."""

    verb: str
    reads: Sequence[Path]
    writes: Sequence[Path]  # files and folders
    run: Callable[[], Outcome]


def work(
    request: Mapping[str, Any], read_line: Callable[[list[str]], Line], contents: Contents, mirror: Mirror
) -> Record:
    """Do a task; faults are in the record.

    :param request: task, words, and the last record of the task, or null; verify; cache, its folder, or null, and
        cache_bytes
    """
    record: Record = {"task": request["task"], "words": request["words"], "version": __version__}
    start = time.perf_counter()
    try:
        line = read_line(mirror.words(request["words"]))
        _check_places(line)
        mirror.fetch(line.reads)
        found = [contents.content_of(path) for path in line.reads]
        words = request["words"]
        digests = [one.digest for one in found]
        said = json.dumps([__version__, list(words), list(digests)], separators=(",", ":"))
        record["key"] = key = hashlib.sha256(said.encode()).hexdigest()
        states = {mirror.name(Path(path)): state for one in found for path, state in one.states.items()}
        record["reads"] = {name: mirror.state(name) if is_url(name) else state for name, state in states.items()}
        kept = _kept(request.get("last"), key, mirror, verify=request.get("verify", False))
        record |= kept or _result(request, line, key, mirror)
    except FacepipeError as error:
        record |= {"status": FAILED, "error": str(error), "passing": _is_passing(error)}
    except (OSError, MemoryError) as error:
        record |= {"status": FAILED, "error": printable(f"{type(error).__name__}: {error}"), "passing": True}
    except Exception as error:  # a fault of ours or of a plug-in: the rest goes on
        what = printable(f"{type(error).__name__}: {' '.join(str(error).split())[:200]}")
        record |= {"status": FAILED, "error": f"{request['task']}: {what}", "passing": False}
    finally:
        mirror.clear()
    record = mirror.with_urls(record)
    return {"seconds": round(time.perf_counter() - start, 4), **record}  # of what is kept those that it took to make it


def _check_places(line: Line) -> None:
    """:raises InputError: something is to be written outside the roots"""
    for path in line.writes:
        if not is_writable(path, trust().roots):
            roots = ", ".join(map(str, trust().roots))
            raise InputError(path, f"is outside the roots ({roots}), expected --root")


def _kept(last: Mapping[str, Any] | None, key: str, mirror: Mirror, *, verify: bool) -> Record | None:
    """The last result, where it is that of the key and still there.

    :param verify: its digests are compared even where nothing seems to have changed
    """
    if last is None or last.get("key") != key or last["status"] == FAILED:
        return None
    writes = {name: [mirror.state(name), own] for name, (_, own) in last["writes"].items()}
    for name, (state, own) in writes.items():
        former = last["writes"][name][0]
        unchanged = former is not None and state == tuple(former) and not verify
        if not unchanged and (state is None or not _has_digest(name, own, mirror)):
            return None
    names = ("report", "missed", "attribution", "verb", "seconds", "peak_mb")
    same = {name: last[name] for name in names if name in last}  # one of others may lack some
    return {**same, "status": KEPT, "writes": writes}


def _has_digest(name: str, own: str, mirror: Mirror) -> bool:
    try:
        return mirror.digest(name) == own
    except InputError:  # a folder, or a pipe: no result
        return False


def _result(request: Mapping[str, Any], line: Line, key: str, mirror: Mirror) -> Record:
    cache = Cache(Path(request["cache"]), request["cache_bytes"], mirror.path) if request.get("cache") else None
    for path in line.writes:
        path.parent.mkdir(parents=True, exist_ok=True)
    with _one_at_a_time(line.writes):
        known = None if cache is None else cache.fetch(key, lambda path: _is_own(path, line))
        record = known or _made(line, mirror)
        if cache is not None and known is None:
            cache.keep(key, record)
    writes = {name: [mirror.put(name, own), own] for name, (_, own) in record["writes"].items()}
    folders = tuple(f"{mirror.name(place)}/" for path in line.writes for place in _places(path))
    before = (request.get("last") or {}).get("writes", {})
    mirror.remove(name for name in before if name not in writes and name.startswith(folders))
    return {**record, "status": CACHED if known else MADE, "writes": writes}


@contextlib.contextmanager
def _one_at_a_time(writes: Sequence[Path]) -> Iterator[None]:
    """Batches with other states may make the same result, of which several files have to belong together.

    :raises ChangedError: another makes it for long
    """
    with contextlib.ExitStack() as ends:
        for path in writes[:1]:
            try:
                ends.enter_context(locked(path))
            except InputError as error:
                if not isinstance(error.__cause__, OSError):  # else its storage has no locks
                    raise ChangedError(path, "is made by another batch, expected one at a time") from error
        yield


def _made(line: Line, mirror: Mirror) -> Record:
    """What a line came to; of what it wrote the digests, its result last."""
    outcome = line.run()
    files = {file for path in line.writes for place in _places(path) for file in _files(place)}
    files |= {beside for path in files for beside in _buffers(path)}
    for path in files:
        mirror.check_named(path)
    ordered = sorted(files, key=lambda path: (path == line.writes[0], path))
    return {
        "verb": line.verb,
        "writes": {mirror.name(path): [None, digest([path])] for path in ordered},
        "report": _brief(json.loads(json.dumps(outcome.report, default=str))),
        "missed": outcome.missed,
        "attribution": sorted({attribution_of(path) for path in (*line.reads, *files)} - {""}),
    }


def _brief(value: Any) -> Any:
    """A report without long lists: a plan keeps one for each task."""
    if isinstance(value, Mapping):
        return {key: _brief(one) for key, one in value.items() if not (hasattr(one, "__len__") and len(one) > _MOST)}
    return value


def _places(path: Path) -> tuple[Path, ...]:
    """Where a result is written: itself, and the textures beside a stage."""
    return (path, texture_folder(path)) if path.suffix.lower() in SUFFIXES else (path,)


def _is_own(path: Path, line: Line) -> bool:
    """Whether a line could have written a file: a result, what lies in one, or what a .gltf has beside it."""
    if any(path.is_relative_to(place) for one in line.writes for place in _places(one)):
        return True
    beside = {(one.parent, one.stem) for one in line.writes if one.suffix.lower() == ".gltf"}
    return path not in line.reads and (path.parent, path.name.partition(".")[0]) in beside


def _buffers(path: Path) -> set[Path]:
    """What a .gltf holds in files beside it, which are called by their content."""
    if path.suffix.lower() != ".gltf":
        return set()
    return {one for one in named(path) if one.is_relative_to(path.parent) and one.is_file()}


def _files(path: Path) -> list[Path]:
    return [one for one in (path, *path.rglob("*")) if one.is_file()]


def _is_passing(error: FacepipeError) -> bool:
    """Whether it may succeed later or elsewhere, as after a full disk, but not after a bad file."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, StoreError | ChangedError) or (isinstance(cause, OSError) and cause.errno in _PASSING):
            return True
        cause = cause.__cause__ or cause.__context__
    return False
