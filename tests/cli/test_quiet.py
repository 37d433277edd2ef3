"""Stderr holds our line and nothing that libraries print beside it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from command_line import exit_code

NOISY = """
import ctypes, os, sys, types, warnings
import numpy as np
from pxr import Tf
from facepipe import cli
from facepipe.core.errors import InputError

def run(arguments):
    np.float32(1e38) * np.float32(1e38)
    np.array([np.nan]).astype(int)
    Tf.Warn("of USD")
    os.write(2, b"of C++\\n")
    warnings.warn("of Python")
    call = ctypes.CFUNCTYPE(None)(lambda: 1 / 0)  # swallowed and reported, as C++ does
    call()
    print("a warning of ours", file=sys.stderr)
    raise InputError("face.usda", "bad")

sys.modules["facepipe.cli.view_command"] = types.SimpleNamespace(run=run, configure=lambda parser, words: None)
"""


def noisy(*flags: str, end: str) -> subprocess.CompletedProcess[str]:
    program = [sys.executable, *flags, "-c", NOISY + end]
    return subprocess.run(program, capture_output=True, text=True, check=False)


def test_only_our_lines_are_on_stderr() -> None:
    done = noisy(end="sys.exit(cli.main(['view']))")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.splitlines() == ["a warning of ours", "facepipe: face.usda: bad"]


def test_stderr_is_as_it_was_after_the_command() -> None:
    done = noisy(end="cli.main(['view'])\nos.write(2, b'raw\\n')\nwarnings.warn('mine')\nprint(sys.stderr.fileno())")
    assert done.stderr.splitlines()[2] == "raw"
    assert "UserWarning: mine" in done.stderr
    assert done.stdout == "2\n"


def test_warnings_that_python_was_asked_for_stay() -> None:
    done = noisy("-W", "default", end="sys.exit(cli.main(['view']))")
    assert "UserWarning: of Python" in done.stderr
    assert "RuntimeWarning: overflow" in done.stderr
    assert "of USD" not in done.stderr


@pytest.mark.skipif(sys.platform == "win32", reason="closes file descriptors as POSIX has them")
def test_a_closed_stderr_stops_nothing(tmp_path: Path) -> None:
    program = "import os, sys\nos.close(2)\nfrom facepipe.cli import main\nsys.exit(main(['schema-path']))"
    done = subprocess.run([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True, check=False)
    assert (done.returncode, done.stdout.count("\n")) == (0, 1)


def test_a_stderr_that_is_no_file_is_written(capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code("inspect", "gone.usda") == 2
    assert capsys.readouterr().err.count("\n") == 1
