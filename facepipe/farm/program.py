"""The process that does tasks of `facepipe batch`: a line of JSON in for each, and one out; ends with its input.

The first line has the settings: the folder that paths are relative to, the roots that confine all reads and writes, and
the version of the asking process.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import gc
import io
import json
import math
import os
import queue
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import IO, Any, NoReturn

from facepipe.cli import command_module, paths_in
from facepipe.cli.action_line import ActionGroup, ActionLine, action_of, inputs_of
from facepipe.cli.parser import Parser
from facepipe.cli.show import quiet_libraries
from facepipe.core import __version__
from facepipe.core.errors import FacepipeError, InputError
from facepipe.core.policy.paths import Trust, trusting
from facepipe.declare import fields_of
from facepipe.farm.contents import Contents
from facepipe.farm.ledger import FAILED, Record
from facepipe.farm.mirror import mirror
from facepipe.farm.work import Line, Outcome, work
from facepipe.kinds import Action, FileAction, InPlaceAction
from facepipe.stage.files import naming

_OTHERS = ("export", "import", "validate", "apply-bones")  # commands that are no actions, and can be steps

_GROWTH = 40.0  # MB at rest that a process may gain before it is replaced: libraries lose some (cholespy each factor)


def main(read: Callable[[list[str]], Line] | None = None) -> None:
    """Answer requests until there are no more; end at once where the asking process has ended.

    :param read: reads lines in place of `read_line`
    """
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what libraries print is no answer
    requests: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(requests,), daemon=True).start()
    setting = json.loads(requests.get())
    contents = Contents()
    if setting["version"] != __version__:
        _serve(requests, answers, _refusing(f"facepipe {__version__} works here, expected {setting['version']}"))
    try:
        os.chdir(setting["folder"])
        with quiet_libraries(), mirror(setting["urls"], setting["local"], setting["local_bytes"]) as copies:
            roots = (*map(Path, setting["roots"]), *copies.roots)
            with trusting(Trust(roots=roots, models=setting["models"], confined=True)), naming(copies.name):
                _serve(requests, answers, lambda request: work(request, read or read_line, contents, copies))
    except (FacepipeError, OSError) as error:  # before the first task
        _serve(requests, answers, _refusing(error))


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
        at_rest, verb = _at_rest_mb(), str(record.get("verb"))
        least = min(at_rest, least if verb in verbs else math.inf)
        verbs.add(verb)
        memory = {"peak_mb": _peak_mb(), "grown": at_rest > least + _GROWTH}
        answers.write(json.dumps({**memory, **record}).encode() + b"\n")
        answers.flush()


def _at_rest_mb() -> float:
    """The memory that stays between two tasks; what is free goes back to the system first."""
    gc.collect()
    if sys.platform != "linux":
        return 0.0
    with contextlib.suppress(AttributeError):  # not glibc
        ctypes.CDLL(None).malloc_trim(0)
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def _listen(requests: queue.SimpleQueue[bytes]) -> None:
    for line in sys.stdin.buffer:
        requests.put(line)
    os._exit(1)


def _peak_mb() -> float | None:
    try:
        import resource
    except ImportError:  # Windows
        return None
    used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(used / (1e6 if sys.platform == "darwin" else 1e3), 1)


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
        parsed = _parsed(parser, words[1:], errors)
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
        reads, more = inputs_of(parsed, action), more
        writes += more
    else:
        reads = [path for path in paths_in(list(vars(parsed).values())) if path not in writes]
        reads += [Path(parsed.rename)] if Path(getattr(parsed, "rename", None) or "-").is_file() else []
        writes += _companions(writes)
    return Line(verb=verb, reads=reads, writes=writes, run=lambda: _run(module, parsed))


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


def _parsed(parser: Parser, words: list[str], errors: io.StringIO) -> argparse.Namespace:
    try:
        parsed: argparse.Namespace = parser.parse_args(words)
        return parsed
    except SystemExit:
        lines = errors.getvalue().strip().splitlines() or [f"{parser.prog}: no line to run"]
        where, _, what = lines[-1].partition(": ")
        raise InputError(where, what) from None


def _run(module: Any, parsed: argparse.Namespace) -> Outcome:
    with _captured() as (printed, _):
        code = int(module.run(parsed))
    try:
        report: Mapping[str, Any] = json.loads(printed.getvalue())
    except ValueError:  # of a command without a report
        report = {}
    return Outcome(missed=code == 1, report=report if isinstance(report, dict) else {"report": report})


@contextlib.contextmanager
def _captured() -> Iterator[tuple[io.StringIO, io.StringIO]]:
    """What is printed in the block: results, and the rest."""
    results, errors = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(results), contextlib.redirect_stderr(errors):
        yield results, errors


if __name__ == "__main__":
    main()
