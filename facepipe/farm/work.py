"""A task done, in the process that does it: its result made, kept, or taken from a cache.

The key is a digest of the line, of all that it reads, and of the version: tasks of one key have the same results.
"""

from __future__ import annotations

import errno
import hashlib
import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from facepipe.core import __version__
from facepipe.core.digests import digest
from facepipe.core.errors import FacepipeError, InputError
from facepipe.core.trust import is_writable, trust
from facepipe.farm.cache import Cache
from facepipe.farm.contents import Contents, state_of, unchanged
from facepipe.farm.ledger import Record
from facepipe.stage.attribution import attribution_of
from facepipe.stage.files import SUFFIXES
from facepipe.stage.textures import texture_folder

_MOST = 40  # entries of a list or mapping in a report that is kept
MADE, KEPT, CACHED, FAILED = "made", "kept", "cached", "failed"
_PASSING = {errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.ENOMEM, errno.ESTALE, errno.EMFILE, errno.ENFILE, errno.EROFS}


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What a line came to."""

    missed: bool = False  # a check or threshold
    report: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Line:
    """A line of the command line, read."""

    verb: str
    reads: Sequence[Path]
    writes: Sequence[Path]  # files and folders
    run: Callable[[], Outcome]


def work(request: Mapping[str, Any], read_line: Callable[[list[str]], Line], contents: Contents) -> Record:
    """Do a task; faults are in the record.

    :param request: task, words, and the last record of the task, or null; cache, its folder, or null, and cache_bytes
    """
    record: Record = {"task": request["task"], "words": request["words"], "version": __version__}
    start = time.perf_counter()
    try:
        line = read_line(list(request["words"]))
        _check_places(line)
        found = [contents.of(path) for path in line.reads]
        record["key"] = key = _key(request["words"], [one.digest for one in found])
        record["reads"] = {path: state for one in found for path, state in one.states.items()}
        record |= _kept(request.get("last"), key) or _result(request, line, key)
    except FacepipeError as error:
        record |= {"status": FAILED, "error": str(error), "passing": _is_passing(error)}
    except (OSError, MemoryError) as error:
        record |= {"status": FAILED, "error": f"{type(error).__name__}: {error}", "passing": True}
    except Exception as error:  # a fault of ours or of a plug-in: the rest goes on
        what = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
        record |= {"status": FAILED, "error": f"{request['task']}: {what}", "passing": False}
    return {"seconds": round(time.perf_counter() - start, 4), **record}  # of what is kept those that it took to make it


def _key(words: Sequence[str], digests: Sequence[str]) -> str:
    said = json.dumps([__version__, list(words), list(digests)], separators=(",", ":"))
    return hashlib.sha256(said.encode()).hexdigest()


def _check_places(line: Line) -> None:
    """:raises InputError: something is to be written outside the roots"""
    for path in line.writes:
        if not is_writable(path, trust().roots):
            roots = ", ".join(map(str, trust().roots))
            raise InputError(path, f"is outside the roots ({roots}), expected --root")


def _kept(last: Mapping[str, Any] | None, key: str) -> Record | None:
    """The last result, where it is that of the key and still there."""
    if last is None or last.get("key") != key or last["status"] == FAILED:
        return None
    for path, (state, own) in last["writes"].items():
        if not unchanged({path: state}) and (state_of(path) is None or digest([Path(path)]) != own):
            return None
    writes = {path: [state_of(path), own] for path, (_, own) in last["writes"].items()}
    same = {name: last.get(name) for name in ("report", "missed", "attribution", "verb", "seconds", "peak_mb")}
    return {**same, "status": KEPT, "writes": writes}


def _result(request: Mapping[str, Any], line: Line, key: str) -> Record:
    cache = Cache(Path(request["cache"]), request["cache_bytes"]) if request.get("cache") else None
    for path in line.writes:
        path.parent.mkdir(parents=True, exist_ok=True)
    known = None if cache is None else cache.fetch(key)
    if known is not None:
        return {**known, "status": CACHED}
    outcome = line.run()
    files = sorted({file for path in line.writes for file in _written(path)})
    record: Record = {
        "status": MADE,
        "verb": line.verb,
        "writes": {path.as_posix(): [state_of(path), digest([path])] for path in files},
        "report": _brief(json.loads(json.dumps(outcome.report, default=str))),
        "missed": outcome.missed,
        "attribution": sorted({attribution_of(path) for path in (*line.reads, *files)} - {""}),
    }
    if cache is not None:
        cache.keep(key, record)
    return record


def _brief(value: Any) -> Any:
    """A report without long lists: a plan keeps one for each task."""
    if isinstance(value, Mapping):
        return {key: _brief(one) for key, one in value.items() if not (hasattr(one, "__len__") and len(one) > _MOST)}
    return value


def _written(path: Path) -> Iterator[Path]:
    """What was written as a result: itself, the files in it, and the textures beside a stage."""
    for one in (path, *([texture_folder(path)] if path.suffix.lower() in SUFFIXES else [])):
        if one.is_dir():
            yield from (file for file in one.rglob("*") if file.is_file())
        elif one.is_file():
            yield one


def _is_passing(error: FacepipeError) -> bool:
    """Whether it can go well another time or elsewhere: a full disk, not a bad file."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, OSError) and cause.errno in _PASSING:
            return True
        cause = cause.__cause__ or cause.__context__
    return False
