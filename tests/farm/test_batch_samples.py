"""The nightly build and the watch folder of samples/, and every kind of work as the steps of a plan."""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
from faces import tiny_face
from places import REPOSITORY

import facepipe
from facepipe.stage import save_parts

WATCHED = """
out = "game"
[faces]
glob = "incoming/*.usda"
[steps.glb]
run = "export {face}"
out = "{name}.glb"
"""


@pytest.mark.slow
def test_the_nightly_build_is_done_and_then_kept(tmp_path: Path) -> None:
    shutil.copy(REPOSITORY / "samples/nightly.toml", tmp_path)
    report = facepipe.batch(tmp_path / "nightly.toml", processes=2, thumbnails=64)
    assert (dict(report.counts), report.failures, report.missed_checks) == ({"made": 24}, (), ())
    assert "ICT-FaceKit" in report.attributions[0]
    assert len([*(tmp_path / "nightly_batch/thumbnails").glob("*.png")]) == 4
    assert dict(facepipe.batch(tmp_path / "nightly.toml", thumbnails=64).counts) == {"kept": 24}


def test_a_watch_folder_takes_what_comes(tmp_path: Path) -> None:
    (tmp_path / "incoming").mkdir()
    (tmp_path / "plan.toml").write_text(WATCHED)
    line = [sys.executable, str(REPOSITORY / "samples/watch_folder.py"), str(tmp_path / "plan.toml"), "0.2"]
    with subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as watching:
        try:
            for name in ("ada", "bea"):
                save_parts(tiny_face(), tmp_path / f"incoming/{name}.usda")
                _wait_for(tmp_path / f"game/{name}.glb")
            assert watching.poll() is None
        finally:
            watching.terminate()
            watching.communicate()


def _wait_for(path: Path) -> None:
    until = time.monotonic() + 120
    while not path.is_file():
        assert time.monotonic() < until
        time.sleep(0.1)
