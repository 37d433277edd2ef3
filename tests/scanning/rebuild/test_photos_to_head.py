"""`facepipe fit-neutral` on a folder of photos: they are scanned first."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import photo_booth
import pytest
from command_line import Capsys, failed, run
from node import validate
from scan_actors import Actor

from facepipe.performing import recipe_to
from facepipe.scanning.photos import Cameras, PhotoScan, ScanPhotosReport
from facepipe.scanning.rebuild.fit_neutral_action import FitNeutralAction
from facepipe.scanning.rebuild.scan_fit import input_of_photos
from facepipe.scans import Scan, ScanLandmarks


@pytest.mark.needs_scan
def test_folders_that_give_no_scan_leave_nothing_behind(
    tmp_path: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    photo_booth.noise_photos(tmp_path / "photos", 4)
    words = ("fit-neutral", tmp_path / "photos", "-o", tmp_path / "person.glb")
    assert "photos: 4 photos" in failed(capsys, *words, folder=tmp_path)
    photo_booth.noise_photos(tmp_path / "photos", 5)
    assert "--unit mm: photos have no unit" in failed(capsys, *words, "--unit", "mm", folder=tmp_path)
    monkeypatch.chdir(tmp_path / "photos")
    assert "degrees apart" in failed(capsys, "fit-neutral", ".", "-o", tmp_path / "person.glb", folder=tmp_path)
    assert failed(capsys, *words, folder=tmp_path).count(f"{tmp_path / 'photos'} -> ") == 1


def test_landmarks_are_those_of_the_photos(tmp_path: Path) -> None:
    known = np.full((68, 3), np.nan)
    known[17:] = 1.0
    made = PhotoScan(
        scan=Scan(name="photos", points=np.zeros((3, 3))),
        cameras=Cameras(),
        landmarks=ScanLandmarks(points=known),
        report=ScanPhotosReport(photos_used=("a.png",), warnings=("of the photos",)),
    )
    (tmp_path / "photos.landmarks.json").write_text("of another scan")
    (tmp_path / "photos").mkdir()
    action = FitNeutralAction(scan=tmp_path / "photos")
    _, landmarks, warnings, photos = input_of_photos(made, action.landmarks)
    assert landmarks is made.landmarks
    assert photos["photos_used"] == ["a.png"]
    assert warnings == ("of the photos",)


def test_recipes_know_when_a_photo_changes(tmp_path: Path) -> None:
    photos = photo_booth.noise_photos(tmp_path / "photos", 2)

    def digests() -> tuple[str, ...]:
        recipe = recipe_to(FitNeutralAction(scan=tmp_path / "photos"), tmp_path / "out.usda")
        assert recipe.sources == ("./photos",)
        return recipe.digests

    before = digests()
    (tmp_path / "photos" / "out.usda").write_text("a result")
    assert digests() == before
    photos[0].write_bytes(photos[1].read_bytes())
    assert digests() != before


@pytest.mark.needs_scan
@pytest.mark.needs_torch
@pytest.mark.slow
def test_photos_become_a_textured_head_by_one_command(tmp_path: Path, capsys: Capsys) -> None:
    cameras = photo_booth.ring((-31, -18, -6, 6, 18, 31), [0], width=480, height=576)
    photo_booth.take_photos(tmp_path / "photos", Actor(5).neutral, cameras)
    glb = tmp_path / "person.glb"
    code, printed, err = run(capsys, "fit-neutral", tmp_path / "photos", "--texture-size", 512, "-o", glb, "--json")
    assert code < 2, err  # 1: the photos are small
    report = json.loads(printed)
    assert len(report["photos"]["photos_used"]) == 6
    assert report["quality"]["surface_mean_mm"] < 1.0
    assert report["colored"] > 0.2
    assert "skin_face_scan.jpg" in report["textures"]
    (checked,) = validate([glb]).values()  # the Khronos validator's
    assert checked["issues"]["numErrors"] == checked["issues"]["numWarnings"] == 0
