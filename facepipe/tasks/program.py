"""The process that does tasks of `facepipe batch` and `facepipe serve`: a line of JSON in for each, and one out.

It ends with its input. The first line has the settings: the folder that paths are relative to, the roots that confine
all reads and writes, and the version of the asking process. A task's result is made, kept, or taken from a cache. Its
key is a digest of the line, of all that it reads, and of the version: tasks of one key have the same results.
"""

from __future__ import annotations

import base64
import contextlib
import ctypes
import errno
import gc
import hashlib
import io
import json
import math
import os
import queue
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, NoReturn, cast

from facepipe.cli import command_module, paths_in
from facepipe.cli.action_line import ActionGroup, ActionLine, action_of, inputs_of
from facepipe.cli.parser import Parser
from facepipe.cli.show import quiet_libraries
from facepipe.core import __version__
from facepipe.core.errors import ChangedError, FacepipeError, InputError, printable
from facepipe.core.locks import locked
from facepipe.core.policy.paths import Trust, is_url, is_writable, trust, trusting
from facepipe.core.reading import digest
from facepipe.core.reports import Bar, unwatched
from facepipe.declare import fields_of
from facepipe.kinds import Action, FileAction, InPlaceAction
from facepipe.stage.array_files import arrays_file
from facepipe.stage.files import SUFFIXES, naming
from facepipe.stage.recipes import attribution_of
from facepipe.stage.textures import texture_folder
from facepipe.tasks.contents import Cache, Contents, named
from facepipe.tasks.ledger import CACHED, FAILED, KEPT, MADE, Record
from facepipe.tasks.mirror import Mirror, mirror
from facepipe.tasks.remote import StoreError

_MOST = 40  # entries of a list or mapping in a report that is kept
_PASSING = {errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.ENOMEM, errno.ESTALE, errno.EMFILE, errno.ENFILE, errno.EROFS}
_OTHERS = ("export", "import", "validate", "apply-bones")  # commands that are no actions, and can be steps
_BETWEEN, _PICTURED = 0.25, 2.0  # seconds, at least, between two lines of progress, and between two with pictures
_GROWTH = 40.0  # MB at rest that a process may gain before it is replaced: libraries lose some (cholespy each factor)


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
    # a result itself, and the textures and arrays beside a stage
    stages = [path for path in line.writes if path.suffix.lower() in SUFFIXES]
    places = [*line.writes, *map(texture_folder, stages), *map(arrays_file, stages)]
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
        record = known or _made(line, places, mirror)
        if cache is not None and known is None:
            cache.keep(key, record)
    writes = {name: [mirror.put(name, own), own] for name, (_, own) in record["writes"].items()}
    folders = tuple(f"{mirror.name(place)}/" for place in places)
    before = (request.get("last") or {}).get("writes", {})
    mirror.remove(name for name in before if name not in writes and name.startswith(folders))
    return {**record, "status": CACHED if known else MADE, "writes": writes}


def _made(line: Line, places: Sequence[Path], mirror: Mirror) -> Record:
    """What a line came to; of what it wrote at some places the digests, its result last."""
    outcome = line.run()
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


def main(read: Callable[[list[str]], Line] | None = None) -> None:
    """Answer requests until there are no more; end at once where the asking process has ended.

    :param read: reads lines in place of `read_line`
    """
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what libraries print is no answer
    requests: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(target=listen, args=(requests,), daemon=True).start()
    setting = json.loads(requests.get())
    contents = Contents()
    if setting["version"] != __version__:
        _serve(requests, answers, _refusing(f"facepipe {__version__} works here, expected {setting['version']}"))
    try:
        os.chdir(setting["folder"])
        with quiet_libraries(), mirror(setting["urls"], setting["local"], setting["local_bytes"]) as copies:
            roots = (*map(Path, setting["roots"]), *copies.roots)
            with trusting(Trust(roots=roots, models=setting["models"], confined=True)), naming(copies.name):

                def do(request: Mapping[str, Any]) -> Record:
                    with _confined(request), _watched(request, answers):
                        return work(request, read or read_line, contents, copies)

                _serve(requests, answers, do)
    except (FacepipeError, OSError) as error:  # before the first task
        _serve(requests, answers, _refusing(error))


@contextlib.contextmanager
def _confined(request: Mapping[str, Any]) -> Iterator[None]:
    """A task that has a folder of its own reads and writes there alone, temporary files too."""
    if "folder" not in request:
        yield
        return
    os.chdir(request["folder"])
    temporary, tempfile.tempdir = tempfile.tempdir, request["folder"]
    try:
        with trusting(Trust(roots=(Path(request["folder"]),), confined=True)):
            yield
    finally:
        tempfile.tempdir = temporary


_answers: ContextVar[tuple[str, IO[bytes]] | None] = ContextVar("facepipe_answers", default=None)


@contextlib.contextmanager
def _watched(request: Mapping[str, Any], answers: IO[bytes]) -> Iterator[None]:
    token = _answers.set((request["task"], answers) if request.get("progress") else None)
    try:
        yield
    finally:
        _answers.reset(token)


@contextlib.contextmanager
def watch(label: str, steps: int) -> Iterator[Bar]:
    """Progress of what a line does, for who asked for it: a line of JSON now and then."""
    asked = _answers.get()
    if asked is None:
        with unwatched(label, steps) as unseen:
            yield unseen
        return
    yield _Bar(label, steps, *asked)


class _Bar:
    def __init__(self, label: str, steps: int, task: str, answers: IO[bytes]) -> None:
        self._label, self._steps, self._task, self._answers = label, max(1, steps), task, answers
        self._done, self._said, self._pictured = 0, 0.0, 0.0
        self._picture: Callable[[], bytes] | None = None
        self._say()

    def show(self, picture: Callable[[], bytes]) -> None:
        """How it stands."""
        self._picture = picture

    def update(self) -> None:
        """One step is done."""
        self._done += 1
        if self._done >= self._steps or time.monotonic() > self._said + _BETWEEN:
            self._say()

    def _say(self) -> None:
        self._said = time.monotonic()
        progress: dict[str, Any] = {"text": self._label, "share": min(1.0, self._done / self._steps)}
        if self._picture is not None and self._said > self._pictured + _PICTURED:
            progress["picture"] = base64.b64encode(self._picture()).decode()
            self._pictured = time.monotonic()  # drawing takes a while too
        self._answers.write(json.dumps({"task": self._task, "progress": progress}).encode() + b"\n")
        self._answers.flush()


def _refusing(why: object) -> Callable[[Mapping[str, Any]], Record]:
    refusal = {"status": FAILED, "error": str(why), "passing": True, "refused": True}
    return lambda request: {"task": request["task"], **refusal}


def _serve(
    requests: queue.SimpleQueue[bytes], answers: IO[bytes], do: Callable[[Mapping[str, Any]], Record]
) -> NoReturn:
    verbs: set[str] = set()
    least = math.inf  # MB that it had at rest since the last verb that was new: modules and data of that stay
    while True:
        record = do(json.loads(requests.get()))
        # memory that stays between two tasks; what is free goes back to the system first
        gc.collect()
        verb, peak = str(record.get("verb")), None
        if sys.platform == "linux":
            with contextlib.suppress(AttributeError):  # not glibc
                ctypes.CDLL(None).malloc_trim(0)
        at_rest = at_rest_mb()
        least = min(at_rest, least if verb in verbs else math.inf)
        verbs.add(verb)
        with contextlib.suppress(ImportError):  # Windows
            import resource

            used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            peak = round(used / (1e6 if sys.platform == "darwin" else 1e3), 1)
        memory = {"peak_mb": peak, "grown": at_rest > least + _GROWTH}
        answers.write(json.dumps({**memory, **record}).encode() + b"\n")
        answers.flush()


def at_rest_mb() -> float:
    """Memory that this process has, in MB; 0 where the system doesn't tell."""
    if sys.platform != "linux":
        return 0.0
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def listen(requests: queue.SimpleQueue[bytes]) -> None:
    """Read requests, lines of JSON, and end with their pipe: who asks has ended."""
    for line in sys.stdin.buffer:
        requests.put(line)
    os._exit(1)


def read_line(words: list[str]) -> Line:
    """A line of the command line, with what it reads and writes.

    :raises InputError: no such command, one that can't be a step, or wrong words for it
    """
    verb = words[0]
    module = command_module(verb)
    if module is None or not (isinstance(module, ActionLine | ActionGroup) or verb in _OTHERS):
        raise InputError(verb[:40], "can't be a step, expected an action, export, import or validate")
    parser = Parser(prog=f"facepipe {verb}", description=module.__doc__, common=False)
    with _captured() as (_, errors):
        module.configure(parser, words[1:])
        try:
            parsed = parser.parse_args(words[1:])
        except SystemExit:
            lines = errors.getvalue().strip().splitlines() or [f"{parser.prog}: no line to run"]
            where, _, what = lines[-1].partition(": ")
            raise InputError(where, what) from None
    parsed.json = parsed.force = True
    writes = [path for path in (getattr(parsed, "output", None), getattr(parsed, "out", None)) if path is not None]
    line = module.line(parsed.action) if isinstance(module, ActionGroup) else module
    if isinstance(line, ActionLine):
        verb = line.kind.verb
        kind = line.kind
        if parsed.edit is not None or (issubclass(kind, InPlaceAction) and not writes):
            raise InputError(kind.verb, "would change its input, which a step can't, expected another result")
        action = action_of(parsed, kind)[1]
        beside = [getattr(action, field.name) for field in fields_of(kind) if field.role == "beside"]
        more = [path for path in beside if path is not None] + _companions(writes, kind)
        reads = inputs_of(parsed, action)
        writes += more
    else:
        reads = [path for path in paths_in(list(vars(parsed).values())) if path not in writes]
        reads += [Path(parsed.rename)] if Path(getattr(parsed, "rename", None) or "-").is_file() else []
        writes += _companions(writes)

    def run() -> Outcome:
        with _captured() as (printed, _):
            code = int(module.run(parsed))
        report: Any = {}  # of a command without one
        with contextlib.suppress(ValueError):
            report = json.loads(printed.getvalue())
        return Outcome(missed=code == 1, report=report if isinstance(report, dict) else {"report": report})

    return Line(verb=verb, reads=reads, writes=writes, run=run)


def _companions(writes: list[Path], kind: type[Action[Any]] | None = None) -> list[Path]:
    """Files that an exporter or an action writes with a result."""
    from facepipe.registry import outputs, suffixes

    if not writes:
        return []
    out = writes[0]
    if kind is not None and issubclass(kind, FileAction):
        return [one for one in kind.with_it(out) if one != out]
    exported = out.suffix.lower().removeprefix(".") in suffixes()
    return [output for output in outputs(out) if output != out] if exported else []


@contextlib.contextmanager
def _captured() -> Iterator[tuple[io.StringIO, io.StringIO]]:
    """What is printed in the block: results, and the rest."""
    results, errors = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(results), contextlib.redirect_stderr(errors):
        yield results, errors


if __name__ == "__main__":
    main()
