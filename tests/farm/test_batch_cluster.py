"""A plan on a Dask cluster of real processes: the same bytes as here, whatever is lost on the way."""

from __future__ import annotations

import re
import shutil
import signal
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil
import pytest
from command_line import Capsys
from command_line import run as command
from conftest import PLAN
from farm_cluster import PATIENCE, Farm, children, farm_in, until

from facepipe.core import __version__
from facepipe.core.errors import InputError
from facepipe.farm.batch import BatchReport, batch
from facepipe.farm.plan import RunOptions, read_plan
from facepipe.tasks import child

pytest.importorskip("distributed")
FACEPIPE = [sys.executable, "-m", "facepipe"]
PEOPLE = """
out = "built"
faces = { range = { seed = [1, 3] } }
[steps.base]
once = true
run = "sample --seed 0 --textures 0"
out = "base.usdc"
[steps.person]
run = "sample --seed {seed} --textures 0"
out = "people/{name}.usdc"
[steps.child]
run = "blend {person} {base}"
out = "children/{name}.usdc"
[steps.game]
run = "export {child}"
out = "game/{name}.glb"
[steps.rig]
run = "export {child}"
out = "rig/{name}.onnx"
"""
SLOW = PLAN.replace("copy {face}", "slow 0.2 {face}")


@pytest.fixture
def farm(show: Path, tmp_path: Path) -> Iterator[Farm]:
    """A scheduler, still without workers."""
    with farm_in(tmp_path / "farm") as one:
        yield one


def faces(show: Path, count: int) -> None:
    for number in range(count):
        (show / f"heads/{number:03}.bin").write_text(str(number))


@contextmanager
def killed(farm: Farm, ticks: Iterable[Callable[[], object]]) -> Iterator[set[int]]:
    """The older worker is killed after each tick, and another started: the ids of the processes that they had."""
    over = threading.Event()
    orphans: set[int] = set()

    def kill() -> None:
        for tick in ticks:
            tick()
            if over.is_set():
                return
            victim = next(worker for worker in farm.workers if worker.poll() is None)
            orphans.update(children(victim))
            victim.kill()
            victim.wait()
            farm.worker()

    killer = threading.Thread(target=kill)
    killer.start()
    try:
        yield orphans
    finally:
        over.set()
        killer.join()


def run(show: Path, text: str, cluster: str | None, **options: Any) -> BatchReport:
    """A plan run on a cluster, or here; each in a state of its own."""
    (show / "plan.toml").write_text(text)
    return batch(
        read_plan(show / "plan.toml"), show / "state", cluster=cluster, processes=1, options=RunOptions(**options)
    )


def results(show: Path) -> dict[str, bytes]:
    return {str(one.relative_to(show)): one.read_bytes() for one in (show / "built").rglob("*") if one.is_file()}


def log(show: Path) -> list[str]:
    """What was really done."""
    return (show / "log").read_text().split() if (show / "log").exists() else []


def forget(show: Path) -> dict[str, bytes]:
    """Remove what was made; what it was."""
    found = results(show)
    for one in (show / "built").rglob("*.bin"):
        one.unlink()
    for one in (show / "state").iterdir():
        one.unlink()
    (show / "log").unlink()
    return found


def test_results_are_those_of_processes_here_and_nothing_is_left_over(show: Path, farm: Farm) -> None:
    run(show, PLAN, None)
    expected = forget(show)
    farm.worker(), farm.worker()
    assert dict(run(show, PLAN, farm.address).counts) == {"made": 6}
    assert results(show) == expected
    assert dict(run(show, PLAN, farm.address).counts) == {"kept": 6}
    for one in farm.workers:
        until(lambda one=one: not children(one))


@pytest.mark.slow
def test_a_worker_that_is_killed_again_and_again_loses_nothing(show: Path, farm: Farm) -> None:
    faces(show, 12)
    run(show, PLAN, None)
    expected = forget(show)
    farm.worker(), farm.worker()
    ticks = (lambda done=done: until(lambda: len(log(show)) >= done) for done in range(4, 30, 6))
    with killed(farm, ticks) as orphans:
        report = run(show, SLOW, farm.address, failures=100)
    assert len(farm.workers) > 5
    assert dict(report.counts) == {"made": 30}
    assert results(show) == expected
    assert orphans
    until(lambda: not any(map(psutil.pid_exists, orphans)))


@pytest.mark.slow
def test_real_faces_have_the_same_bytes_though_workers_are_killed(tmp_path: Path) -> None:
    show = tmp_path / "show"
    show.mkdir()
    run(show, PEOPLE, None)
    expected = results(show)
    for one in ("built", "state"):
        shutil.rmtree(show / one)
    with farm_in(tmp_path / "farm", workers=2, made_up=False) as farm:
        ticks = (
            lambda done=done: until(lambda: len([*(show / "built").glob("*/[!.]*.*")]) >= done, 900.0)
            for done in (3, 6, 9)
        )
        with killed(farm, ticks):
            report = run(show, PEOPLE, farm.address, failures=100)
        assert len(farm.workers) > 3
    assert dict(report.counts) == {"made": 13}
    assert results(show) == expected


@pytest.mark.slow
def test_a_worker_that_hangs_loses_nothing(show: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DASK_DISTRIBUTED__SCHEDULER__WORKER_TTL", "3s")  # five minutes by default
    faces(show, 9)
    with farm_in(tmp_path / "farm", workers=2) as farm:
        stop = threading.Thread(
            target=lambda: (until(lambda: len(log(show)) > 3), farm.workers[0].send_signal(signal.SIGSTOP))
        )
        stop.start()
        assert dict(run(show, SLOW, farm.address).counts) == {"made": 24}
        stop.join()


@pytest.mark.slow
def test_a_cluster_that_vanishes_is_a_line_and_the_next_run_does_the_rest(show: Path, farm: Farm) -> None:
    faces(show, 9)
    farm.worker()
    slow = SLOW.replace("0.2", "0.1")
    (show / "plan.toml").write_text(slow)
    words = ["batch", str(show / "plan.toml"), "--state", str(show / "state"), "--thumbnails", "0", "--quiet"]
    process = subprocess.Popen([*FACEPIPE, *words, "--cluster", farm.address], stdout=-1, stderr=-1, text=True)
    until(lambda: len(log(show)) > 3)
    farm.scheduler.kill()
    out, err = process.communicate(timeout=PATIENCE)
    assert (process.returncode, err) == (1, "")
    (line,) = [splitline for splitline in out.splitlines() if "gone" in splitline]
    left = int(re.fullmatch(r"failed: the cluster is gone: (\d+) tasks are left, run it again to do them", line)[1])
    assert dict(run(show, slow, None).counts) == {"kept": 24 - left, "made": left}
    again = [name for name, times in Counter(log(show)).items() if times > 1]
    assert len(again) <= 3  # what the worker had in hand, and answers on their way


def test_a_cluster_that_is_not_there_is_a_line(show: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(child, "_CONNECT", 0.1)
    (show / "plan.toml").write_text(PLAN)
    code, out, err = command(capsys, "batch", show / "plan.toml", "--cluster", "tcp://127.0.0.1:9")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert err.startswith("facepipe: --cluster tcp://127.0.0.1:9: can't be used: ")


def test_a_worker_of_another_version_is_refused(show: Path, farm: Farm) -> None:
    farm.worker(FARM_VERSION="9.9")
    with pytest.raises(InputError, match=f"has facepipe 9.9, expected {__version__}"):
        run(show, PLAN, farm.address)
    assert not (show / "built").exists()


@pytest.mark.slow
def test_a_worker_of_another_version_that_comes_later_gets_nothing(show: Path, farm: Farm) -> None:
    faces(show, 9)
    farm.worker()
    mark = show / "mark"  # the other refuses a task: only now the first goes on

    def come() -> None:
        until((show / "waits").exists)
        farm.worker(FARM_VERSION="9.9", FARM_MARK=str(mark))

    later = threading.Thread(target=come)
    later.start()
    report = run(show, PLAN.replace("copy {face}", f"wait {mark} {{face}}"), farm.address, failures=0)
    later.join()
    assert dict(report.counts) == {"made": 24}, report.failures
    (line,) = report.warnings
    assert f"facepipe 9.9 works here, expected {__version__}; its tasks go to others" in line


def test_a_task_that_hangs_on_a_cluster_is_ended(show: Path, farm: Farm) -> None:
    farm.worker()
    more = '[steps.bad]\nonce = true\nrun = "hang"\nseconds = 0.5\npriority = 1\n'
    report = run(show, PLAN + more, farm.address, failures=1)
    assert report.failures == ("bad: took more than 0.5 seconds",)
    assert dict(report.counts) == {"made": 6, "failed": 1}
