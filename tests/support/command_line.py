"""facepipe's command line, run in this process."""

from __future__ import annotations

from pathlib import Path

import pytest
from places import REPOSITORY

from facepipe.actions import cookable, summaries
from facepipe.cli import COMMANDS, main
from facepipe.declare import fields_of

Capsys = pytest.CaptureFixture[str]


def exit_code(*words: object) -> int:
    """Of a command whose output does not matter."""
    try:
        return main([str(word) for word in words])
    except SystemExit as stop:  # usage
        return int(stop.code or 0)


def run(capsys: Capsys, *words: object) -> tuple[int, str, str]:
    """Exit code, stdout, stderr."""
    code = exit_code(*words)
    out, err = capsys.readouterr()
    return code, out, err


def done(capsys: Capsys, *words: object, quiet: bool = True) -> str:
    """Stdout of a command that must do its work, without a warning where `quiet`."""
    code, out, err = run(capsys, *words)
    assert code == 0, err
    assert not (quiet and err), err
    return out


def failed(capsys: Capsys, *words: object, folder: Path = Path()) -> str:
    """The one line of a command that must refuse its input and change nothing in a folder."""
    assert folder.resolve() != REPOSITORY, "expected a folder of the test"
    before = content(folder)
    code, out, err = run(capsys, *words)
    assert (code, out, err.count("\n")) == (2, "", 1), (code, out, err)
    assert content(folder) == before
    return err.removeprefix("facepipe: ")


def content(folder: Path) -> dict[Path, bytes]:
    """All that is below a folder; folders hold no bytes."""
    return {path: path.read_bytes() if path.is_file() else b"" for path in folder.rglob("*")}


def plain_actions() -> set[str]:
    """Commands that do an action alone, and write its face alone: as that of every action is written."""
    kinds = {verb: cookable(verb) for verb in summaries() if " " not in verb and verb not in COMMANDS}
    return {verb for verb, kind in kinds.items() if kind and all(field.role != "beside" for field in fields_of(kind))}
