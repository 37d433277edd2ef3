"""The same bytes from the same input, whatever the threads, the seed of hashes and the order in which folders list."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import plain_actions
from import_data import shared
from places import SUPPORT

from facepipe.cli import commands_of

SETTINGS = ((1, 1), (4, 2))  # threads, seed
THREADS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS")
WRITER = SUPPORT / "every_writer.py"
# these write text to stdout, or what others write, or take minutes
OTHERS = {
    "completion",
    "demo",
    "batch",
    "serve",
    "inspect",
    "validate",
    "eval",
    "view",
    "schema-path",
    "scan",
    "scan-landmarks",
    "blender-addon",
}


@pytest.mark.needs_torch
@pytest.mark.gate
@pytest.mark.slow
def test_every_command_writes_the_same_bytes(tmp_path: Path) -> None:
    for name in ("ict_facekit/ict_facekit.npz", "makehuman/makehuman_head.npz"):
        shared(name)
    folders = [tmp_path / str(threads) for threads, _ in SETTINGS]
    for (threads, seed), folder in zip(SETTINGS, folders, strict=True):  # not at once: their threads would wait
        _write(threads, seed, folder)
    first, other = map(_digests, folders)
    assert len(first) > 90
    assert [name for name in first.keys() | other.keys() if first.get(name) != other.get(name)] == []


def test_every_writing_command_is_among_them() -> None:
    """But for actions that are written as others are."""
    lines = WRITER.read_text(encoding="utf-8").splitlines()
    written = {line.split(" ")[0] for line in lines}
    assert commands_of().keys() - OTHERS - plain_actions() <= written
    assert written & plain_actions()


def _write(threads: int, seed: int, folder: Path) -> None:
    folder.mkdir()
    settings = {**dict.fromkeys(THREADS, str(threads)), "PYTHONHASHSEED": str(seed)}
    command = [sys.executable, str(WRITER), str(seed)]
    done = subprocess.run(command, cwd=folder, env=os.environ | settings, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]


def _digests(folder: Path) -> dict[str, str]:
    files = (one for one in folder.rglob("*") if one.is_file())
    return {one.relative_to(folder).as_posix(): hashlib.sha256(one.read_bytes()).hexdigest() for one in files}
