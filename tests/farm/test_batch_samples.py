"""The nightly build and the watch folder of samples/, and every kind of work as the steps of a plan."""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
import scan_domes
from every_writer import PROJECT
from faces import tiny_face
from photographed_face import write_photos
from places import REPOSITORY
from rebuild_stages import put_scans
from small_head import make

import facepipe
from facepipe.scanning.database import save_database
from facepipe.stage import save_parts

pytestmark = pytest.mark.needs_torch

WATCHED = """
out = "game"
[faces]
glob = "incoming/*.usda"
[steps.glb]
run = "export {face}"
out = "{name}.glb"
"""


@pytest.mark.gate
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


LONG = """
out = "done"
[faces]
rows = [{ name = "anna", project = "anna.toml", image = "front" }]
[steps.actor]
run = "rebuild {project} --joint --report {out}/report"
out = "{name}.usda"
[steps.photo]
run = '''fit-photo {image}.png small.usda --landmarks {image}.json --iterations 1 --size 64 --identity 0
         --report {out}/photo'''
out = "{name}_photo.usda"
[steps.lods]
run = "lod {actor} --triangles 100"
out = "{name}_lods.usda"
[steps.rig]
run = "neural-rig train dome.usda --spread 50 --sweep 5 --together 20 --steps 20 --encoder-steps 5"
out = "dome.fpnr"
once = true
[steps.graph]
run = "export dome.usda --neural {rig}"
out = "rig.onnx"
once = true
[steps.check]
run = "validate {lods}"
"""


@pytest.mark.slow
def test_rebuilds_photo_fits_levels_and_training_are_steps(tmp_path: Path) -> None:
    put_scans(tmp_path)
    save_database(scan_domes.database(), tmp_path / "faces.fpdb")
    (tmp_path / "anna.toml").write_text(PROJECT)
    save_parts(scan_domes.face(0), tmp_path / "dome.usda")
    save_parts(make(0), tmp_path / "small.usda")
    write_photos(make(0), tmp_path)
    (tmp_path / "plan.toml").write_text(LONG)
    report = facepipe.batch(tmp_path / "plan.toml", processes=2)
    assert report.failures == ()
    assert dict(report.counts) == {"made": 6}
    assert (tmp_path / "done/report").is_dir()
    assert dict(facepipe.batch(tmp_path / "plan.toml").counts) == {"kept": 6}
    scan = tmp_path / "open.ply"
    scan.write_bytes(scan.read_bytes() + b"\n")  # a source that the project names
    again = dict(facepipe.batch(tmp_path / "plan.toml").counts)
    assert again["kept"] >= 3
    assert again["made"] >= 1
