"""facepipe's command line, run in this process."""

from __future__ import annotations

from pathlib import Path

import pytest

from facepipe.cli import main

Capsys = pytest.CaptureFixture[str]


def run(capsys: Capsys, *words: object) -> tuple[int, str, str]:
    """Exit code, stdout, stderr."""
    try:
        code = main([str(word) for word in words])
    except SystemExit as stop:
        code = int(stop.code or 0)
    out, err = capsys.readouterr()
    return code, out, err


def done(capsys: Capsys, *words: object) -> str:
    """Stdout of a command that must do its work without a warning."""
    code, out, err = run(capsys, *words)
    assert (code, err) == (0, ""), (code, err)
    return out


def failed(capsys: Capsys, *words: object) -> str:
    """The one line of a command that must refuse its input and change no file."""
    before = content(Path.cwd())
    code, out, err = run(capsys, *words)
    assert (code, out, err.count("\n")) == (2, "", 1), (code, out, err)
    assert content(Path.cwd()) == before
    return err.removeprefix("facepipe: ")


def content(folder: Path) -> dict[Path, bytes]:
    """All files below a folder."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
