"""`facepipe batch` killed at random moments: what is done stays, and nothing comes out otherwise."""

from __future__ import annotations

import json
import random
import shutil
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import psutil
import pytest
from conftest import PLAN
from faces import tiny_face
from farm_cluster import children, until
from places import SUPPORT

from facepipe.stage import save_parts

KILLS, PROCESSES = 10, 2
MADE_UP = [sys.executable, str(SUPPORT / "farm_batch.py")]
FACEPIPE = [sys.executable, "-m", "facepipe"]
REAL = """
out = "built"
[faces]
glob = "heads/*.usda"
[steps.mixed]
run = "blend {face} base.usda"
out = "mixed/{name}.usda"
[steps.game]
run = "export {mixed}"
out = "game/{name}.glb"
[steps.rig]
run = "export {mixed}"
out = "rig/{name}.onnx"
"""


def start(show: Path, program: list[str]) -> subprocess.Popen[bytes]:
    words = ["batch", str(show / "plan.toml"), "--state", str(show / "state"), "--thumbnails", "0"]
    return subprocess.Popen([*program, *words, "--processes", str(PROCESSES)], stdout=-3, stderr=-3)


def recorded(show: Path) -> dict[str, dict[str, Any]]:
    """What the ledger has of each task that was done."""
    path = show / "state/tasks.jsonl"
    whole = (
        [splitline for splitline in path.read_text().splitlines(keepends=True) if splitline.endswith("\n")]
        if path.exists()
        else []
    )
    return {one["task"]: one for one in map(json.loads, whole)}


def content(show: Path) -> dict[str, bytes]:
    """All that is below the folder of results, hidden files too."""
    found = (show / "built").rglob("*")
    return {one.relative_to(show).as_posix(): one.read_bytes() for one in found if one.is_file()}


def killed_again_and_again(show: Path, program: list[str]) -> None:
    """Run the plan undisturbed; then anew, killed at random moments, and to its end."""
    assert start(show, program).wait() == 0
    expected, total = content(show), len(recorded(show))
    for one in ("built", "state"):
        shutil.rmtree(show / one)
    (show / "log").unlink(missing_ok=True)
    rng = random.Random(7)
    aims = sorted(rng.sample(range(total), KILLS))  # how much is done when it is killed, at least
    done: dict[str, dict[str, Any]] = {}
    for number in range(KILLS + 1):
        process = start(show, program)
        if number < KILLS:
            until(lambda aim=aims[number]: len(recorded(show)) >= aim)
            time.sleep(rng.random() / 5)
            orphans = children(process)
            process.kill()
            process.wait()
            until(lambda orphans=orphans: not any(map(psutil.pid_exists, orphans)))
        else:
            assert process.wait() == 0
        now = recorded(show)
        assert {name: now[name] for name in done} == done  # nothing that was done was done again
        done = now
    assert len(done) == total
    assert content(show) == expected


@pytest.mark.gate
@pytest.mark.slow
def test_made_up_tasks(show: Path) -> None:
    for number in range(40):
        (show / f"heads/{number:03}.bin").write_text(str(number))
    (show / "plan.toml").write_text(PLAN.replace("copy {face}", "slow 0.05 {face}"))
    killed_again_and_again(show, MADE_UP)
    times = Counter((show / "log").read_text().split())
    assert len(times) == 86
    assert sum(times.values()) - len(times) <= KILLS * PROCESSES  # what was in hand


@pytest.mark.slow
def test_real_faces(tmp_path: Path) -> None:
    (tmp_path / "heads").mkdir()
    for seed in range(10):
        save_parts(tiny_face(seed), tmp_path / f"heads/{seed}.usda")
    save_parts(tiny_face(10), tmp_path / "base.usda")
    (tmp_path / "plan.toml").write_text(REAL)
    killed_again_and_again(tmp_path, FACEPIPE)
