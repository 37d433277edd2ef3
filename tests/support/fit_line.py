"""`facepipe fit-bones` as a test runs it, and the files that it reads."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from blend_line import content
from bone_faces import clip, pose, saved, sculpt, small

from facepipe.cli import main
from facepipe.rig import build

Capsys = pytest.CaptureFixture[str]


def save_sources(folder: Path) -> Path:
    """rig.usda with a clip, a goal within its reach, limits."""
    rig = build(small())
    saved(replace(small(), animations=(clip(rig),)), folder / "rig.usda")
    saved(sculpt(small(), rig.evaluate(coefficients=pose(rig, 1))), folder / "goal.usda")
    (folder / "limits.json").write_text('{"joints": {"*": {"t": [-1, 1], "s": [0.5, 2]}}, "units": "stage"}')
    return folder


def run(capsys: Capsys, *words: object) -> tuple[int, str, str]:
    """Exit code, stdout, stderr."""
    try:
        code = main(["fit-bones", *map(str, words)])
    except SystemExit as stop:
        code = int(stop.code or 0)
    out, err = capsys.readouterr()
    return code, out, err


def done(capsys: Capsys, *words: object) -> str:
    """Stdout of a command that must reach its targets without a warning."""
    code, out, err = run(capsys, *words)
    assert (code, err) == (0, "")
    return out


def failed(capsys: Capsys, *words: object) -> str:
    """The one line of a command that must fail and change no file."""
    before = content(Path.cwd())
    code, out, err = run(capsys, *words)
    assert (code, out, err.count("\n")) == (2, "", 1), err
    assert content(Path.cwd()) == before
    return err.removeprefix("facepipe: ")
