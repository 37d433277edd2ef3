"""Small files that ask for much are refused by their counts, before the memory is taken."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest
from places import SUPPORT

if sys.platform != "linux":
    pytest.skip("memory is measured as Linux does", allow_module_level=True)

from bombs import GROUPS

MOST = 500 * 10**6  # bytes of the whole process
QUICK = "one of each"  # the others take longer or say less
MARKS = (pytest.mark.gate, pytest.mark.slow)


@pytest.mark.parametrize("group", [one if one == QUICK else pytest.param(one, marks=MARKS) for one in GROUPS])
def test_bombs_are_refused_within_bounds(group: str) -> None:
    program = SUPPORT / "bombs.py"
    done = subprocess.run([sys.executable, program, group], capture_output=True, text=True, check=False, timeout=600)
    assert done.returncode == 0, done.stderr
    for load in json.loads(done.stdout):
        assert load["error"].count("\n") == 1, load
        assert load["expected"].casefold() in load["error"].casefold(), load  # Pillow has changed the case of its words
        assert (load["code"], load["peak"] < MOST) == (2, True), load
