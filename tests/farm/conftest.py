"""A folder with small files, and plans run over them by processes that do made-up lines."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from farm_forks import Fork
from places import REPOSITORY

from facepipe.core.policy import children
from facepipe.farm.batch import BatchReport, batch
from facepipe.farm.plan import RunOptions, read_plan
from facepipe.tasks import child

Runner = Callable[..., BatchReport]


@pytest.fixture
def show(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with three faces, and a base, of a few bytes each."""
    monkeypatch.setattr(child, "PROGRAM", "farm_child")
    path = [str(REPOSITORY / "tests/support"), *filter(None, [os.environ.get("PYTHONPATH")])]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(path))
    if sys.platform == "linux":
        monkeypatch.setattr(children, "start", Fork)
    folder = tmp_path / "show"
    (folder / "heads").mkdir(parents=True)
    for name in ("ada", "bea", "cyd"):
        (folder / f"heads/{name}.bin").write_text(name)
    (folder / "base.bin").write_text("base")
    return folder


@pytest.fixture
def run_plan(show: Path) -> Runner:
    """Write a plan and run it."""

    def run(text: str = "", processes: int = 1, **options: Any) -> BatchReport:
        path = show / "plan.toml"
        if text:
            path.write_text(text)
        return batch(read_plan(path), show / "state", processes=processes, options=RunOptions(**options))

    return run


PLAN = """
out = "built"
[faces]
glob = "heads/*.bin"
[steps.mixed]
run = "copy {face} base.bin"
out = "mixed/{name}.bin"
[steps.game]
run = "copy {mixed}"
out = "game/{name}.bin"
"""
