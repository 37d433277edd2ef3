"""A cluster that is started on hosts by ssh."""

from __future__ import annotations

import os
import subprocess
import sys
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


def remote() -> set[int]:
    """Processes of schedulers and workers that were started by ssh."""
    return {
        one.pid
        for one in psutil.process_iter(["cmdline"])
        if "distributed.cli.dask_spec" in (one.info["cmdline"] or ())
    }


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
    before = remote()
    with ssh_server(tmp_path / "ssh") as home:
        code, out, err = command(home, tmp_path / "show", "--cluster", "ssh://localhost", "--processes", "2")
        assert code == 0, out + err
        until(lambda: not remote() - before)
        assert {one.name: one.read_bytes() for one in (tmp_path / "show").glob("*.glb")} == expected
    code, out, err = command(home, tmp_path / "show", "--cluster", "ssh://localhost")
    assert (code, out, err.count("\n")) == (2, "", 1), err
    assert "--cluster ssh://localhost: can't be used: " in err
