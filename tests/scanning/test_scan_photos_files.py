"""What goes into scans from photos, and what is refused: photos, masks, cameras, markers, options."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
import numpy.typing as npt
import pytest
from photo_booth import camera_at, noise_photos
from PIL import Image

from facepipe.core.errors import FacepipeError, InputError
from facepipe.declare import fields_of
from facepipe.scanning.photos import (
    Cameras,
    ScanPhotos,
    ScanPhotosOptions,
    read_cameras,
    read_markers,
    write_cameras,
)
from facepipe.scanning.photos.photos import read_photos
from facepipe.scanning.photos.scan import PhotoScan, ScanPhotosReport, bars
from facepipe.scanning.photos.structure import Structure
from facepipe.scans import Scan, ScanLandmarks

FloatArray = npt.NDArray[np.floating]

LENS = (-0.11, 0.05, 0.002, -0.003)


def test_cameras_survive_their_file(tmp_path: Path) -> None:
    wanted = {"a.jpg": camera_at(np.array([120.0, 60.0, 700.0]), 0.4, distortion=LENS)}
    write_cameras(tmp_path / "rig.json", Cameras(cameras=wanted, unit="cm"))
    found = read_cameras(tmp_path / "rig.json")
    points = np.random.default_rng(12).uniform(-80, 80, (9, 3))
    assert found.unit == "cm"
    np.testing.assert_allclose(found.cameras["a.jpg"].project(points), wanted["a.jpg"].project(points), atol=1e-9)


def camera_text(**changes: object) -> str:
    one = {"width": 640, "height": 480, "focal": 900, "rotation": np.eye(3).tolist(), "translation": [0, 0, 5]}
    return json.dumps({"cameras": {"a.jpg": one | changes}})


CAMERA_FAULTS = {
    "{": "JSON",
    "{}": "cameras",
    '{"cameras": {}}': "cameras",
    '{"cameras": {"a.jpg": 3}}': "object",
    '{"unit": "ell", "cameras": {}}': "mm, cm, m",
    camera_text(width=0): "option width: is 0, expected a number from 1 to 100000",
    camera_text(width=True): "width: True, expected a whole number",
    camera_text(focal=-5): "above 0",
    camera_text(focal="long"): "focal",
    camera_text(center=[1, float("nan")]): "finite",
    camera_text(distortion=[0, 0]): "distortion: [0, 0], expected a list of 4 of which each is a finite number",
    camera_text(rotation=(2 * np.eye(3)).tolist()): "no rotation",
    camera_text(rotation=np.diag([1, 1, -1]).tolist()): "no rotation",
    camera_text(translation=[1, 2]): "translation: [1, 2], expected a list of 3 of which each is a finite number",
    camera_text(lens="85 mm"): "unknown",
}


@pytest.mark.parametrize(("text", "words"), CAMERA_FAULTS.items())
def test_files_that_hold_no_cameras_are_refused(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "rig.json"
    path.write_text(text)
    refuses(lambda: read_cameras(path), words, path)


@pytest.mark.parametrize(
    "text",
    [
        "[]",
        '{"photos": 1}',
        '{"photos": {"a": []}}',
        '{"photos": {"a": {"m": [1]}}}',
        '{"photos": {"a": {"m": [1, NaN]}}}',
        '{"photos": {"a": {"m": [1, 1' + "0" * 400 + "]}}}",
    ],
)
def test_files_that_hold_no_markers_are_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "markers.json"
    path.write_text(text)
    refuses(lambda: read_markers(path), "expected", path)


def refuses(work: Callable[[], object], words: str, path: Path) -> None:
    """`work` fails with one line that names the file and says `words`."""
    with pytest.raises(FacepipeError) as caught:
        work()
    assert words in str(caught.value)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_photos_are_upright_small_and_know_their_lens(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6  # turned by a quarter
    exif[0x8769] = {0xA405: 85}
    files = noise_photos(tmp_path / "photos", 1, (300, 200), exif=exif)
    photo = read_photos(files, 150)[0]
    assert photo.full_size == (200, 300)
    assert (photo.width, photo.height) == (100, 150)
    assert photo.focal == pytest.approx(85 / 36 * 150)
    with Image.open(files[0]) as image:
        raw = np.asarray(image)
    block = np.rot90(raw, -1).reshape(150, 2, 100, 2, 3).mean(axis=(1, 3))
    assert np.abs(photo.pixels - block).mean() < 12


def test_masks_belong_to_photos(tmp_path: Path) -> None:
    files, masks = noise_photos(tmp_path / "photos", 1), tmp_path / "masks"
    masks.mkdir()
    refuses(lambda: read_photos(files, 500, masks), "missing", masks / "0.png")
    Image.new("L", (90, 64), 255).save(masks / "0.png")
    refuses(lambda: read_photos(files, 500, masks), "96 x 64", masks / "0.png")
    Image.new("L", (96, 64), 0).save(masks / "0.png")
    refuses(lambda: read_photos(files, 500, masks), "black", masks / "0.png")
    Image.fromarray(np.repeat([[127, 128]], 48, axis=1).repeat(64, axis=0).astype(np.uint8)).save(masks / "0.png")
    mask = read_photos(files, 500, masks)[0].mask
    assert mask is not None
    assert not mask[:, :48].any()
    assert mask[:, 48:].all()


def test_folders_that_are_no_photos_are_refused(tmp_path: Path) -> None:
    scan = ScanPhotos()
    refuses(lambda: scan(tmp_path / "none"), "no folder", tmp_path / "none")
    folder = tmp_path / "photos"
    noise_photos(folder, 4)
    refuses(lambda: scan(folder), "4 photos", folder)
    (folder / "broken.jpg").write_bytes(b"\xff\xd8\xff\xe0 no picture")
    refuses(lambda: scan(folder), "cut short", folder / "broken.jpg")
    (folder / "broken.jpg").unlink()
    Image.new("RGB", (20, 20)).save(folder / "tiny.png")
    refuses(lambda: scan(folder), "20 x 20", folder / "tiny.png")


def test_cameras_that_do_not_fit_the_photos_are_refused(tmp_path: Path) -> None:
    files = noise_photos(tmp_path / "photos", 5)
    one = camera_at(np.array([0.0, 0.0, 700.0]))
    few = ScanPhotos(cameras=Cameras(cameras={file.name: replace(one, width=96, height=64) for file in files[:4]}))
    refuses(lambda: few(tmp_path / "photos"), "4 photos", tmp_path / "photos")
    other = ScanPhotos(cameras=Cameras(cameras={file.name: one for file in files}))
    refuses(lambda: other(tmp_path / "photos"), "640 x 800", tmp_path / "photos" / "0.png")


def test_photos_without_a_camera_are_named(tmp_path: Path) -> None:
    files = noise_photos(tmp_path / "photos", 6)
    one = camera_at(np.array([0.0, 0.0, 700.0]), width=96, height=64)
    cameras = {file.name: one for file in files[:5]}
    structure = Structure(cameras=cameras, points=np.zeros((0, 3)), seen=np.zeros((5, 0), bool), error=0.0)
    made = PhotoScan(
        scan=Scan(name="photos", points=np.zeros((1, 3))),
        cameras=Cameras(cameras=cameras),
        landmarks=ScanLandmarks(points=np.zeros((0, 3))),
        report=ScanPhotosReport(warnings=("of the surface",)),
    )
    scan = "facepipe.scanning.photos.scan"
    with (
        mock.patch(f"{scan}.find_structure", return_value=structure),
        mock.patch.object(ScanPhotos, "_scan", return_value=made),
    ):
        given, found = (ScanPhotos(cameras=known)(tmp_path / "photos").report for known in (made.cameras, None))
    assert given.photos_unused == found.photos_unused == ("5.png",)
    assert given.warnings == ("1 of 6 photos have no known camera: 5.png", "of the surface")
    assert found.warnings == ("1 of 6 photos could not be placed: 5.png", "of the surface")


def test_one_bar_is_open_at_a_time() -> None:
    events: list[str] = []

    @contextmanager
    def watch(name: str, total: int) -> Iterator[mock.Mock]:
        events.append(f"{name} of {total}")
        yield mock.Mock(update=lambda: events.append("step"))
        events.append(f"{name} ends")

    with bars(watch) as step:
        for name, total in (("cameras", 1), ("depth", 2), ("depth", 2)):
            step(name, total)
    assert events == ["cameras of 1", "step", "cameras ends", "depth of 2", "step", "step", "depth ends"]


def test_options_have_ranges() -> None:
    for field in fields_of(ScanPhotosOptions):
        if field.high is not None:
            with pytest.raises(InputError, match=field.name):
                ScanPhotosOptions(**{field.name: field.high * 2})
    with pytest.raises(InputError, match="lens"):
        ScanPhotosOptions(lens="none")
    with pytest.raises(InputError, match="above 0"):
        ScanPhotos(marker_distance=("a", "b", 0.0))
    with pytest.raises(InputError, match="one of them"):
        ScanPhotos(marker_distance=("a", "b", 100.0), cameras=Cameras())
    assert ScanPhotos(marker_distance=("a", "b", 100.0)).cameras is None
