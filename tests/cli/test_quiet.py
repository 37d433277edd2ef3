"""Stderr holds our line and nothing that libraries print beside it; less with --quiet, more with --verbose."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import Capsys, done, exit_code, failed, run
from faces import tiny_face

from facepipe.cli import commands_of
from facepipe.stage import save_parts

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
    ended = noisy(end="sys.exit(cli.main(['view']))")
    assert (ended.returncode, ended.stdout) == (2, "")
    assert ended.stderr.splitlines() == ["a warning of ours", "facepipe: face.usda: bad"]


def test_stderr_is_as_it_was_after_the_command() -> None:
    ended = noisy(end="cli.main(['view'])\nos.write(2, b'raw\\n')\nwarnings.warn('mine')\nprint(sys.stderr.fileno())")
    assert ended.stderr.splitlines()[2] == "raw"
    assert "UserWarning: mine" in ended.stderr
    assert ended.stdout == "2\n"


def test_warnings_that_python_was_asked_for_stay() -> None:
    ended = noisy("-W", "default", end="sys.exit(cli.main(['view']))")
    assert "UserWarning: of Python" in ended.stderr
    assert "RuntimeWarning: overflow" in ended.stderr
    assert "of USD" not in ended.stderr


@pytest.mark.skipif(sys.platform == "win32", reason="closes file descriptors as POSIX has them")
def test_a_closed_stderr_stops_nothing(tmp_path: Path) -> None:
    program = "import os, sys\nos.close(2)\nfrom facepipe.cli import main\nsys.exit(main(['schema-path']))"
    ended = subprocess.run([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True, check=False)
    assert (ended.returncode, ended.stdout.count("\n")) == (0, 1)


def test_a_stderr_that_is_no_file_is_written(capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code("inspect", "gone.usda") == 2
    assert capsys.readouterr().err.count("\n") == 1


@pytest.fixture
def face(tmp_path: Path) -> Path:
    save_parts(tiny_face(), tmp_path / "face.usda")
    return tmp_path / "face.usda"


def test_quiet_leaves_errors_alone(face: Path, capsys: Capsys) -> None:
    words = ("export", face, "-o", face.with_suffix(".glb"), "--rename", "vrm", "--force")
    assert "names changed" in run(capsys, *words)[2]
    for flags in (("-q", *words), (*words, "--quiet")):
        code, out, err = run(capsys, *flags)
        assert (code, err) == (0, "")
        assert "face.glb" in out
    assert failed(capsys, "inspect", face.with_name("gone.usda"), "-q", folder=face.parent).endswith("no such file\n")


def test_verbose_says_what_is_done_and_when(face: Path, capsys: Capsys) -> None:
    out = face.with_name("out.usda")
    (face.parent / "points.json").write_text("[1, 2]")
    words = ("landmarks", face, "--from", face.with_name("points.json"), "-o", out, "--force")
    usual, before = run(capsys, *words), out.read_bytes()
    code, said, err = run(capsys, *words, "-v")
    assert (code, said) == usual[:2]
    assert out.read_bytes() == before
    lines = err.splitlines()
    assert all(re.fullmatch(r"facepipe: \d+ ms: .+", line) for line in lines)
    assert [line.rpartition(" ms: ")[2].partition(" ")[0] for line in lines] == ["facepipe", f"{out}:", "exit"]
    assert run(capsys, *words)[2] == ""


def test_bars_are_logged_with_their_seconds(folder: Path, capsys: Capsys) -> None:
    err = run(capsys, "validate", "a.usda", "b.usda", "--verbose")[2]
    assert re.search(r"ms: validate: 2 step\(s\) in \d+\.\d{3} s$", err, re.MULTILINE)


def test_quiet_and_verbose_exclude_each_other(face: Path, capsys: Capsys) -> None:
    assert "not allowed with" in failed(capsys, "inspect", face, "-v", "-q", folder=face.parent)


@pytest.mark.parametrize("command", commands_of())
def test_every_command_takes_them(command: str, capsys: Capsys) -> None:
    out = done(capsys, command, "--help")
    assert "-v, --verbose" in out
    assert "-q, --quiet" in out
