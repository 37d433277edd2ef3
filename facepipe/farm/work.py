"""A task, in the process that does it: its result is made, kept, or taken from a cache.

The key is a digest of the line, of all that it reads, and of the version: tasks of one key have the same results.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

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
        last, kept = request.get("last"), None
        if last is not None and last.get("key") == key and last["status"] != FAILED:
            kept = _kept(last, mirror, verify=request.get("verify", False))
        record |= kept or _result(request, line, key, mirror)
    except FacepipeError as error:
        # whether it may succeed later or elsewhere, as after a full disk, but not after a bad file
        passing, cause = False, cast("BaseException | None", error)
        while cause is not None and not passing:
            passing = isinstance(cause, StoreError | ChangedError)
            passing |= isinstance(cause, OSError) and cause.errno in _PASSING
            cause = cause.__cause__ or cause.__context__
        record |= {"status": FAILED, "error": str(error), "passing": passing}
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


def _kept(last: Mapping[str, Any], mirror: Mirror, *, verify: bool) -> Record | None:
    """The last result, where it is still there.

    :param verify: its digests are compared even where nothing seems to have changed
    """
    writes = {name: [mirror.state(name), own] for name, (_, own) in last["writes"].items()}
    for name, (state, own) in writes.items():
        former = last["writes"][name][0]
        unchanged = former is not None and state == tuple(former) and not verify
        if not unchanged:
            try:
                if state is None or mirror.digest(name) != own:
                    return None
            except InputError:  # a folder, or a pipe: no result
                return None
    names = ("report", "missed", "attribution", "verb", "seconds", "peak_mb")
    same = {name: last[name] for name in names if name in last}  # one of others may lack some
    return {**same, "status": KEPT, "writes": writes}


def _result(request: Mapping[str, Any], line: Line, key: str, mirror: Mirror) -> Record:
    cache = Cache(Path(request["cache"]), request["cache_bytes"], mirror.path) if request.get("cache") else None
    for path in line.writes:
        path.parent.mkdir(parents=True, exist_ok=True)
    places = [place for path in line.writes for place in _places(path)]
    beside = {(one.parent, one.stem) for one in line.writes if one.suffix.lower() == ".gltf"}

    def is_own(path: Path) -> bool:
        """Whether the line could have written it: a result, what lies in one, or what a .gltf has beside it."""
        if any(path.is_relative_to(place) for place in places):
            return True
        return path not in line.reads and (path.parent, path.name.partition(".")[0]) in beside

    with contextlib.ExitStack() as ends:
        # batches with other states may make the same result, of which several files have to belong together
        for path in line.writes[:1]:
            try:
                ends.enter_context(locked(path))
            except InputError as error:
                if not isinstance(error.__cause__, OSError):  # else its storage has no locks
                    raise ChangedError(path, "is made by another batch, expected one at a time") from error
        known = None if cache is None else cache.fetch(key, is_own)
        record = known or _made(line, mirror)
        if cache is not None and known is None:
            cache.keep(key, record)
    writes = {name: [mirror.put(name, own), own] for name, (_, own) in record["writes"].items()}
    folders = tuple(f"{mirror.name(place)}/" for place in places)
    before = (request.get("last") or {}).get("writes", {})
    mirror.remove(name for name in before if name not in writes and name.startswith(folders))
    return {**record, "status": CACHED if known else MADE, "writes": writes}


def _made(line: Line, mirror: Mirror) -> Record:
    """What a line came to; of what it wrote the digests, its result last."""
    outcome = line.run()
    places = [place for path in line.writes for place in _places(path)]
    files = {file for place in places for file in (place, *place.rglob("*")) if file.is_file()}
    for path in [one for one in files if one.suffix.lower() == ".gltf"]:  # files beside it are called by their content
        files |= {one for one in named(path) if one.is_relative_to(path.parent) and one.is_file()}
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
