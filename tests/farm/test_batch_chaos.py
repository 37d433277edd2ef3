"""Batches whose cluster or neighbours fail on the way: nothing is lost or done twice, and the bytes are the same."""

from __future__ import annotations

import json
import re
import shutil
import signal
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import psutil
import pytest
from conftest import PLAN, Runner
from faces import tiny_face, with_meshes
from farm_cluster import PATIENCE, Farm, children, farm_in, until
from places import SUPPORT
from textures import COLORS, picture, textured

from facepipe.core.locks import try_lock
from facepipe.farm.batch import batch
from facepipe.farm.plan import read_plan
from facepipe.parts import Material
from facepipe.stage import save_parts
from facepipe.tasks import child

FACES = 12
_started: list[subprocess.Popen[str]] = []
MADE_UP = (str(SUPPORT / "farm_batch.py"),)
REAL = """
out = "built"
[faces]
glob = "heads/*.usda"
[steps.mixed]
run = "blend --flatten {face} base.usda"
out = "mixed/{name}.usda"
[steps.game]
run = "export {mixed}"
out = "game/{name}.gltf"
[steps.rig]
run = "export {face}"
out = "rig/{name}.onnx"
"""
SLOW = PLAN.replace("copy {face}", "slow 0.2 {face}")


@pytest.fixture(autouse=True)
def none_left() -> Iterator[None]:
    """End the batches of a test that failed."""
    yield
    while _started:
        with _started.pop() as process:
            process.kill()


@pytest.fixture
def farm(show: Path, tmp_path: Path) -> Iterator[Farm]:
    """A scheduler, still without workers."""
    pytest.importorskip("distributed")
    with farm_in(tmp_path / "farm") as one:
        yield one


@pytest.fixture
def expected(show: Path, run_plan: Runner) -> dict[str, bytes]:
    """What comes out undisturbed."""
    for number in range(FACES - 3):
        (show / f"heads/{number:03}.bin").write_text(str(number))
    assert dict(run_plan(PLAN).counts) == {"made": 2 * FACES}
    found = results(show)
    for folder in ("built", "state"):
        (show / folder).rename(show.parent / f"undisturbed {folder}")
    (show / "log").unlink()
    return found


def results(show: Path) -> dict[str, bytes]:
    """All that is below the folder of results, hidden files too."""
    found = (show / "built").rglob("*")
    return {one.relative_to(show).as_posix(): one.read_bytes() for one in found if one.is_file()}


def recorded(show: Path, state: str = "state") -> dict[str, dict[str, Any]]:
    """What the ledger has of each task that was done."""
    path = show / state / "tasks.jsonl"
    lines = path.read_text().splitlines(keepends=True) if path.exists() else []
    return {one["task"]: one for one in map(json.loads, (line for line in lines if line.endswith("\n")))}


def start(show: Path, *words: str, program: Sequence[str] = MADE_UP, **names: str) -> subprocess.Popen[str]:
    """:param names: of plan and state, where these are others"""
    plan, state = show / names.get("plan", "plan.toml"), show / names.get("state", "state")
    line = ["batch", str(plan), "--state", str(state), "--thumbnails", "0", *words]
    _started.append(subprocess.Popen([sys.executable, *program, *line], stdout=-1, stderr=-1, text=True))
    return _started[-1]


def tasks_left(out: str) -> int:
    """How many tasks the one line about the cluster says are left."""
    (line,) = [line for line in out.splitlines() if line.startswith("failed: ")]
    found = re.fullmatch(r"failed: the cluster is gone: (\d+) tasks are left, run it again to do them", line)
    assert found, line
    return int(found[1])


@pytest.mark.slow
def test_batch_scheduler_and_nanny_are_killed_one_after_the_other(
    show: Path, farm: Farm, expected: dict[str, bytes]
) -> None:
    (show / "plan.toml").write_text(SLOW)
    farm.worker(), farm.worker(nanny=True)
    process = start(show, "--cluster", farm.address)
    until(lambda: len(recorded(show)) > 3)
    process.kill()
    process.communicate()
    first = recorded(show)

    process = start(show, "--cluster", farm.address, "--quiet")
    until(lambda: len(recorded(show)) > len(first) + 3)
    orphans = {one for worker in farm.workers for one in children(worker)}
    farm.restart()
    out, err = process.communicate(timeout=PATIENCE)
    assert (process.returncode, err) == (1, "")
    second = recorded(show)
    assert len(second) == 2 * FACES - tasks_left(out)

    nanny = farm.worker(nanny=True)
    process = start(show, "--cluster", farm.address)
    until(lambda: len(recorded(show)) > len(second) + 3)  # which its children have done: there is no other worker
    orphans |= children(nanny)
    farm.worker()
    nanny.kill()
    out, err = process.communicate(timeout=PATIENCE)
    assert (process.returncode, "failed" in out + err) == (0, False)

    last = recorded(show)
    assert all(second[name] == record for name, record in first.items())
    assert all(last[name] == record or last[name]["status"] == "kept" for name, record in second.items())
    assert results(show) == expected
    until(lambda: not any(map(psutil.pid_exists, orphans)))
    until(lambda: not children(farm.workers[-1]))


@pytest.mark.slow
@pytest.mark.parametrize("lost", ["scheduler", "workers"])
def test_a_cluster_that_says_nothing_more_is_given_up(
    show: Path, run_plan: Runner, farm: Farm, expected: dict[str, bytes], monkeypatch: pytest.MonkeyPatch, lost: str
) -> None:
    for name, seconds in {"_LOOK": 0.1, "_ABSENT": 2.0, "_PATIENCE": 1.0}.items():  # minutes
        monkeypatch.setattr(child, name, seconds)
    (show / "plan.toml").write_text(SLOW)
    worker = farm.worker()

    def lose() -> None:
        until(lambda: len(recorded(show)) > 3)
        if lost == "scheduler":
            farm.scheduler.send_signal(signal.SIGSTOP)
        else:
            worker.kill()

    loser = threading.Thread(target=lose)
    loser.start()
    report = batch(read_plan(show / "plan.toml"), show / "state", cluster=farm.address)
    loser.join()
    left = 2 * FACES - len(recorded(show))
    line = f"no scheduler with workers has answered for 2 seconds: {left} tasks are left, run it again to do them"
    assert report.failures == (line,)
    assert dict(run_plan().counts) == {"kept": 2 * FACES - left, "made": left}
    assert results(show) == expected


def test_a_second_batch_of_one_state_is_refused_at_once(show: Path, expected: dict[str, bytes]) -> None:
    mark = show / "mark"
    (show / "plan.toml").write_text(PLAN.replace("copy {face}", f"wait {mark} {{face}}"))
    first = start(show)
    until((show / "waits").exists)
    out, err = start(show).communicate(timeout=PATIENCE)
    assert (out, err.count("\n")) == ("", 1)
    assert "tasks.jsonl: is being changed by another process, expected one at a time" in err
    assert not (show / "built/game").exists()
    mark.touch()
    assert first.communicate(timeout=PATIENCE)[1].endswith(f"{2 * FACES} made\n")
    assert results(show) == expected
    assert set(Counter((show / "log").read_text().split()).values()) == {1}


@pytest.mark.slow
def test_batches_of_other_states_may_make_the_same_files_at_once(tmp_path: Path) -> None:
    """With one cache of results; another plan has the same folders. Several files of a result come from the cache."""
    (tmp_path / "heads").mkdir()
    skin = Material(name="Skin", diffuse_color=textured(picture("skin.png", COLORS)))
    for seed in range(2):
        face = replace(with_meshes(tiny_face(seed), material="Skin"), materials=(skin,))
        save_parts(face, tmp_path / f"heads/{seed}.usda")
    save_parts(tiny_face(2), tmp_path / "base.usda")
    (tmp_path / "plan.toml").write_text(REAL)
    (tmp_path / "other.toml").write_text(REAL.replace("{name}", "{name}_other"))
    words = "--cache", str(tmp_path / "cache"), "--processes", "1"

    def run(*plans: str) -> list[str]:
        started = [
            start(tmp_path, *words, program=("-m", "facepipe"), state=f"{number}", plan=plan)
            for number, plan in enumerate(plans)
        ]
        said = [process.communicate(timeout=300) for process in started]
        assert [process.returncode for process in started] == [0] * len(plans), said
        return [out.splitlines()[0].partition(": ")[2] for out, _ in said]

    assert run("plan.toml") == ["6 made"]
    expected = results(tmp_path)
    assert {name for record in recorded(tmp_path, "0").values() for name in record["writes"]} == set(expected)
    for folder in ("built", "0", "cache"):
        shutil.rmtree(tmp_path / folder)
    run("plan.toml", "plan.toml", "other.toml")
    assert {name: data for name, data in results(tmp_path).items() if "_other" not in name} == expected
    shutil.rmtree(tmp_path / "built")
    assert "made" not in "".join(run("plan.toml", "plan.toml"))
    assert results(tmp_path) == expected
    assert run("plan.toml", "plan.toml") == ["6 kept"] * 2


def test_a_result_is_made_by_one_batch_at_a_time(show: Path, run_plan: Runner, expected: dict[str, bytes]) -> None:
    """Its place is locked while it is made, and a batch that was killed meanwhile leaves no lock behind in the end."""
    mark = show / "mark"
    text = PLAN.replace("copy {face}", f"wait {mark} {{face}}")
    (show / "plan.toml").write_text(text)
    first = start(show, "--processes", "1")
    until((show / "waits").exists)
    (lock,) = (show / "built/mixed").glob(".*.lock")
    with pytest.raises(BlockingIOError):
        try_lock(lock)
    first.kill()
    first.wait()
    mark.touch()
    assert dict(run_plan().counts) == {"made": 2 * FACES}
    assert results(show) == expected
