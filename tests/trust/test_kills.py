"""Commands that are killed while they write: old or new, never mixed, and clean once they are run again."""

from __future__ import annotations

import subprocess
import sys

import pytest
from command_line import plain_actions
from kill_lines import LINES, LONG, READERS
from places import SUPPORT

from facepipe.cli import commands_of

PARTS = 12


def test_every_command_that_writes_is_killed() -> None:
    """But for actions that are written as others are; tests/farm kills batches, and tests/server servers."""
    killed = {name.split()[0] for name in LINES} - {"deliver", "save"} | {"batch", "serve"}  # those are functions
    assert killed | READERS | plain_actions() == {*commands_of()}
    assert killed & plain_actions()
    assert not killed & READERS


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="forks, and sees which files are open by /proc")
@pytest.mark.parametrize("part", [pytest.param(0, marks=pytest.mark.gate), *range(1, PARTS)])
def test_a_kill_leaves_old_or_new_and_nothing_after_another_run(part: int) -> None:
    """At some random steps and moments; `python tests/support/kills.py --random 200` takes all, and long."""
    names = [name for name in LINES if name not in LONG]
    words = [sys.executable, str(SUPPORT / "kills.py"), "--brief", *names[part::PARTS]]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr[-2000:]
