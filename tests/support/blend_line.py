"""`facepipe blend` as a test runs it, and small faces for it; the folder with them is in conftest.py."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from faces import replace_mesh, tiny_face

import facepipe
from facepipe.cli import main
from facepipe.parts import FaceParts
from facepipe.stage import save_parts

Capsys = pytest.CaptureFixture[str]
WORDS = ("--set", "mouth=0.75,0.25", "--default", "0.5,0.5")


def made(seed: int) -> FaceParts:
    """A small face with points of its own."""
    parts, rng = tiny_face(seed), np.random.default_rng(seed)
    meshes = [replace_mesh(mesh, points=mesh.points + rng.normal(0, 0.05, mesh.points.shape)) for mesh in parts.meshes]
    return dataclasses.replace(parts, meshes=tuple(meshes))


def run(capsys: Capsys, *words: object) -> tuple[int, str, str]:
    """Exit code, stdout, stderr of `facepipe blend`."""
    try:
        code = main(["blend", *(str(word) for word in words)])
    except SystemExit as stop:
        code = int(stop.code or 0)
    out, err = capsys.readouterr()
    return code, out, err


def done(capsys: Capsys, *words: object) -> str:
    """Stdout of a command that must do its work without a warning."""
    code, out, err = run(capsys, *words)
    assert (code, err) == (0, "")
    return out


def failed(capsys: Capsys, *words: object) -> str:
    """The one line of a command that must fail and change no file."""
    before = content(Path.cwd())
    code, out, err = run(capsys, *words)
    assert (code, out, err.count("\n")) == (2, "", 1), err
    assert content(Path.cwd()) == before
    return err


def content(folder: Path) -> dict[Path, bytes]:
    return {file: file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def points(path: str) -> Any:
    return facepipe.open(path).evaluate()


def saved(parts: FaceParts, name: str, **mesh_changes: Any) -> None:
    """Save the face with every mesh changed."""
    meshes = tuple(replace_mesh(mesh, **mesh_changes) for mesh in parts.meshes)
    save_parts(dataclasses.replace(parts, meshes=meshes), Path(name))
