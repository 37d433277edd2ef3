"""A process for tasks of made-up lines: it copies files, dies, hangs, or takes memory, as a line says."""

from __future__ import annotations

import os
import shutil
import signal
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from facepipe import core

core.__version__ = os.environ.get("FARM_VERSION", core.__version__)  # before others take it

from facepipe.tasks import program  # noqa: E402
from facepipe.tasks.program import Line, Outcome, main  # noqa: E402
from facepipe.tasks.program import read_line as read_command  # noqa: E402

_kept: list[bytes] = []

if "FARM_MARK" in os.environ:  # touched when a task is refused: until it is done by others, no run can end
    refusing = program._refusing

    def _marking(why: object) -> Callable[[Mapping[str, Any]], dict[str, Any]]:
        def refuse(request: Mapping[str, Any]) -> dict[str, Any]:
            Path(os.environ["FARM_MARK"]).touch()
            return refusing(why)(request)

        return refuse

    program._refusing = _marking


def read_line(words: list[str]) -> Line:
    """``copy SOURCE ... -o OUT``, ``slow SECONDS SOURCE ... -o OUT``, ``wait MARK SOURCE ... -o OUT``, ``die``,
    ``die-once MARK``, ``hang``, ``eat MB``, ``fill -o OUT``, ``keep NAME -o OUT``; else a command.
    """
    verb, rest = words[0], words[1:]
    out = [Path(rest[rest.index("-o") + 1])] if "-o" in rest else []
    named = [Path(one) for one in (rest[: rest.index("-o")] if out else rest)]
    made = {
        "copy": _copy,
        "slow": _slow,
        "wait": _wait,
        "die": _die,
        "die-once": _die_once,
        "hang": _hang,
        "eat": _eat,
        "fill": _fill,
        "keep": _keep,
    }.get(verb)
    if made is None:
        return read_command(words)
    reads = {"copy": named, "slow": named[1:], "wait": named[1:]}.get(verb, [])
    return Line(verb=verb, reads=reads, writes=out, run=lambda: made(named, out))


def _copy(sources: list[Path], out: list[Path]) -> Outcome:
    out[0].write_bytes(b"".join(source.read_bytes() for source in sources))
    with Path("log").open("a") as log:  # what was really done
        log.write(f"{out[0].as_posix()}\n")
    return Outcome(report={"off_mm": 0.25})


def _slow(named: list[Path], out: list[Path]) -> Outcome:
    time.sleep(float(str(named[0])))
    return _copy(named[1:], out)


def _wait(named: list[Path], out: list[Path]) -> Outcome:
    """Say that it waits, by a file beside the mark, and wait for the mark."""
    named[0].with_name("waits").touch()
    until = time.monotonic() + 60
    while not named[0].exists() and time.monotonic() < until:
        time.sleep(0.05)
    return _copy(named[1:], out)


def _die(*_: object) -> Outcome:
    os.kill(os.getpid(), signal.SIGKILL)
    return Outcome()


def _die_once(marks: list[Path], out: list[Path]) -> Outcome:
    if not marks[0].exists():
        marks[0].touch()
        _die()
    shutil.copyfile(marks[0], out[0])
    return Outcome()


def _hang(*_: object) -> Outcome:
    time.sleep(600)
    return Outcome()


def _eat(amounts: list[Path], out: list[Path]) -> Outcome:
    held = bytearray(os.urandom(1 << 20)) * int(str(amounts[0]))
    time.sleep(600)
    return Outcome(report={"held": len(held)})


def _keep(sources: list[Path], out: list[Path]) -> Outcome:
    _kept.append(os.urandom(1 << 20) * 60)
    out[0].write_text(str(os.getpid()))
    return Outcome()


def _fill(sources: list[Path], out: list[Path]) -> Outcome:
    raise OSError(28, "No space left on device")


if __name__ == "__main__":
    main(read_line)
