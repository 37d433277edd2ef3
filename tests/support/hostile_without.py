"""Whether hostile folders are seen to do harm without the checks that stand against them: those are taken out one at a
time, in a process of its own for each folder.

usage: python tests/support/hostile_without.py [WORD ...]      kinds whose names have a word (default all)

A row each: the checks without which it does harm, alone or (with +) together. Exit 1 where none of them matters.
"""

from __future__ import annotations

import importlib
import inspect
import itertools
import os
import resource
import signal
import sys
import tempfile
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from command_line import exit_code
from full_faces import full_face
from hostile_folders import Hostile, World, harm, make_stock
from hostile_kinds import HOSTILE
from small_sources import made

_SECONDS, _BYTES = 20, 3 << 30  # what takes more does harm too
_MOST = 3  # checks that one folder may need to be taken out together


class Check(NamedTuple):
    """A function, or a line of it, that refuses something."""

    function: str  # module:name
    line: str = ""  # a part of its source; empty: all of it
    instead: str = "None"  # of all of it: what it returns

    @property
    def name(self) -> str:
        """For people."""
        return self.function.rpartition(".")[2] + (f" ({self.line})" if self.line else "")


CHECKS = (
    Check("facepipe.core.policy.paths:is_below", instead="True"),
    Check("facepipe.core.policy.paths:is_writable", instead="True"),
    Check("facepipe.core.policy.paths:check_beside"),
    Check("facepipe.core.policy.paths:check_copied"),
    Check("facepipe.core.policy.paths:check_model"),
    Check("facepipe.core.policy.paths:check_readable"),
    Check("facepipe.core.policy.paths:check_writable"),
)


def without(check: Check) -> None:
    """From now on this process has no such check, wherever it was imported to."""
    module, _, path = check.function.partition(":")
    function: Any = importlib.import_module(module)
    for part in path.split("."):
        function = getattr(function, part)
    function = inspect.unwrap(function)
    made: dict[str, Any] = {}
    if check.line:
        source = textwrap.dedent(inspect.getsource(function))
        assert source.count(check.line) == 1, f"{check.function} has no single `{check.line}`"
        exec(source.replace(check.line, check.instead), function.__globals__, made)
        function.__code__ = inspect.unwrap(made[function.__name__]).__code__
    else:
        function.__code__ = eval(f"lambda *_, **__: {check.instead}").__code__


def is_harmed(hostile: Hostile, stock: Path, checks: Sequence[Check]) -> bool:
    """Whether a folder does harm without some checks, or runs out of time or memory, in a process of its own."""
    pid = os.fork()
    if pid == 0:
        resource.setrlimit(resource.RLIMIT_DATA, (_BYTES, _BYTES))
        signal.alarm(_SECONDS)
        code = 1
        try:
            with tempfile.TemporaryDirectory() as top:
                world = World(Path(top).resolve())
                world.settle(stock)
                os.chdir(world.sent)
                hostile.make(world)
                for check in checks:
                    without(check)
                code = 1 if harm(hostile, world, ()) else 0
        finally:
            os._exit(code)
    return os.waitpid(pid, 0)[1] != 0


def needed(hostile: Hostile, stock: Path) -> list[str]:
    """The checks without which it does harm; together, where it needs that."""
    assert not is_harmed(hostile, stock, ()), hostile.name
    for count in range(1, _MOST + 1):
        found = [
            " + ".join(check.name for check in checks)
            for checks in itertools.combinations(CHECKS, count)
            if is_harmed(hostile, stock, checks)
        ]
        if found:
            return found
    return []


def main() -> int:
    """Print the table."""
    kinds = [one for one in HOSTILE if not sys.argv[1:] or any(word in one.name for word in sys.argv[1:])]
    with tempfile.TemporaryDirectory() as folder:
        stock = Path(folder, "stock")
        stock.mkdir()
        make_stock(stock, full_face(), (made(1), made(2)))
        for words in (("inspect", "face.usda"), ("export", "face.usda", "-o", "x.glb"), ("cook", "mix.usda")):
            exit_code(*words)  # what they load is loaded once
        failed = 0
        for one in kinds:
            found = needed(one, stock)
            failed += not found
            print(f"{one.name:60} {', '.join(found) or '-'}", flush=True)
    print(f"{len(kinds)} kinds, {failed} that no check matters to")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
