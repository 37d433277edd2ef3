"""A cluster that is started on hosts by ssh."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest
from faces import tiny_face
from farm_cluster import until
from ssh_server import SSHD, ssh_server

from facepipe.stage import save_parts

pytest.importorskip("asyncssh")


def command(home: Path, folder: Path, *words: str) -> tuple[int, str, str]:
    line = [sys.executable, "-m", "facepipe", "batch", "--each", "heads/*.usda", "-o", "{name}.glb", *words]
    line += ["--thumbnails", "0", "--", "export", "{face}"]
    environment = {**os.environ, "HOME": str(home)}
    done = subprocess.run(line, cwd=folder, env=environment, capture_output=True, text=True, timeout=1200)
    return done.returncode, done.stdout, done.stderr


def remote() -> dict[int, list[str]]:
    """Processes of schedulers and workers that were started by ssh, and their lines."""
    lines = {one.pid: one.info["cmdline"] or [] for one in psutil.process_iter(["cmdline"])}
    return {pid: line for pid, line in lines.items() if "distributed.cli.dask_spec" in line}


@contextmanager
def watched() -> Iterator[dict[int, list[str]]]:
    """Those that are there at some time in the block, and their children."""
    seen: dict[int, list[str]] = {}
    ended = threading.Event()

    def look() -> None:
        while not ended.wait(0.05):
            for pid, line in remote().items():
                seen[pid] = line
                with contextlib.suppress(psutil.Error):
                    seen.update({one.pid: one.cmdline() for one in psutil.Process(pid).children() if one.cmdline()})

    watcher = threading.Thread(target=look)
    watcher.start()
    try:
        yield seen
    finally:
        ended.set()
        watcher.join()


@pytest.mark.slow
@pytest.mark.skipif(SSHD is None, reason="no sshd: apt-get install openssh-server")
def test_a_host_is_reached_by_ssh_and_nothing_is_left_over_there(tmp_path: Path) -> None:
    (tmp_path / "show/heads").mkdir(parents=True)
    for seed in range(3):
        save_parts(tiny_face(seed), tmp_path / f"show/heads/{seed}.usda")
    here = tmp_path / "here"
    code, out, err = command(tmp_path, tmp_path / "show", "--state", str(here), "--processes", "1")
    expected = {one.name: one.read_bytes() for one in (tmp_path / "show").glob("*.glb")}
    assert (code, len(expected)) == (0, 3), out + err
    for name in expected:
        (tmp_path / "show" / name).unlink()
    before = remote().keys()
    with ssh_server(tmp_path / "ssh") as home, watched() as seen:
        code, out, err = command(home, tmp_path / "show", "--cluster", "ssh://localhost", "--processes", "2")
        assert code == 0, out + err
        until(lambda: not remote().keys() - before)
        assert {one.name: one.read_bytes() for one in (tmp_path / "show").glob("*.glb")} == expected
    pythons = [line for pid, line in seen.items() if pid not in before and line[0] == sys.executable]
    assert len(pythons) >= 3, "a scheduler, a nanny, and its worker"
    assert [line for line in pythons if "-P" not in line] == [], "none imports from the folder that ssh starts in"
    code, out, err = command(home, tmp_path / "show", "--cluster", "ssh://localhost")
    assert (code, out, err.count("\n")) == (2, "", 1), err
    assert "--cluster ssh://localhost: can't be used: " in err
