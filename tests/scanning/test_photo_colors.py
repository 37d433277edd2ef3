"""The colours that photos show of a scan's surface."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import photo_booth
import pytest
from photo_booth import camera_at
from PIL import Image
from scan_actors import Actor, ict

from facepipe.core.arrays import FloatArray
from facepipe.geometry.colors import from_srgb
from facepipe.geometry.similarity import Similarity, fit_similarity
from facepipe.scanning.photos import PhotoCamera, ScanPhotos, ScanPhotosOptions
from facepipe.scanning.photos.depth import pixel_rays
from facepipe.scanning.photos.scan import PhotoColors
from facepipe.scanning.texture import scan_samples
from facepipe.scans import Scan

LENS = (-0.11, 0.05, 0.002, -0.003)
CAMERAS = {
    f"{number}.png": camera_at(np.array([x, 0.0, 700.0]), distortion=LENS)
    for number, x in enumerate((-200.0, 0.0, 150.0))
}


def painted(points: FloatArray) -> FloatArray:
    """(m, 3) sRGB of a wall across z: stripes of 8 mm."""
    return np.stack([0.5 + 0.4 * np.sin(points[:, 0] * np.pi / 4), *(0.4 + points[:, :2].T / 400)], axis=1)


def photograph(camera: PhotoCamera) -> Image.Image:
    """The wall, and a red screen before its middle."""
    rays = pixel_rays(camera) @ camera.rotation
    wall, screen = (camera.eye + rays * ((z - camera.eye[2]) / rays[:, [2]]) for z in (0.0, 200.0))
    before = (np.abs(screen[:, :2]) < 20.0).all(axis=1)
    shown = np.where(before[:, None], (1.0, 0.0, 0.0), painted(wall))
    return Image.fromarray((shown.reshape(camera.height, camera.width, 3) * 255 + 0.5).astype(np.uint8))


def square(half: float, z: float) -> FloatArray:
    """(4, 3) corners."""
    return np.array([[-half, -half, z], [half, -half, z], [-half, half, z], [half, half, z]])


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Scan:
    """The wall and the screen, grey at their points, with three photos."""
    folder = tmp_path_factory.mktemp("photos")
    for name, camera in CAMERAS.items():
        photograph(camera).save(folder / name)
    points = np.concatenate([square(90.0, 0.0), square(20.0, 200.0)])
    triangles = np.array([[0, 1, 2], [1, 3, 2], [4, 5, 6], [5, 7, 6]])
    photos = PhotoColors(folder=folder, cameras=CAMERAS, points=points, triangles=triangles)
    return Scan(name="wall", points=points, triangles=triangles, colors=np.full((8, 3), 0.2), photos=photos)


@pytest.mark.needs_scan
def test_places_have_the_colours_of_the_photos_that_see_them(scan: Scan) -> None:
    assert scan.photos is not None
    places = np.column_stack([np.random.default_rng(0).uniform(-85, 85, (4000, 2)), np.zeros(4000)])
    ahead = np.tile([0.0, 0.0, 1.0], (4000, 1))
    colors = scan.photos(places, ahead, 0.1)
    assert np.isfinite(colors).all()  # what the screen hides from one, others see
    assert np.abs(colors - from_srgb(painted(places))).max() < 0.03
    assert np.isnan(scan.photos(places, -ahead, 0.1)).all()
    coarse = scan.photos(places, ahead, 20.0)  # wider than the stripes
    assert coarse[:, 0].std() < 0.3 * colors[:, 0].std()


@pytest.mark.needs_scan
def test_samples_take_the_photos_colours_wherever_the_scan_is(scan: Scan) -> None:
    c, s = np.cos(0.7), np.sin(0.7)
    place = Similarity(
        rotation=np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]), translation=np.array([5.0, -3.0, 9.0]), scale=0.1
    )
    samples = scan_samples(scan, place, np.full(3, -99.0), np.full(3, 99.0), 0.02)
    assert samples.colors is not None
    at = place.undo(samples.points)
    wall = at[:, 2] < 100
    assert np.abs(samples.colors[wall] - from_srgb(painted(at[wall]))).max() < 0.03
    assert np.median(samples.colors[~wall], axis=0) == pytest.approx([1.0, 0.0, 0.0], abs=0.02)
    turned = replace(scan, triangles=scan.triangles[:, ::-1])
    np.testing.assert_allclose(scan_samples(turned, place, np.full(3, -99.0), np.full(3, 99.0), 0.02).colors, 0.2)


@pytest.mark.needs_scan
@pytest.mark.slow
def test_photos_show_pores_that_colours_at_points_do_not(tmp_path: Path) -> None:
    cameras = photo_booth.ring((-31, -18, -6, 6, 18, 31), [0], width=480, height=576)
    truth = Actor(5).neutral
    photo_booth.take_photos(tmp_path / "photos", truth, cameras)
    made = ScanPhotos(options=ScanPhotosOptions(landmarks=False))(tmp_path / "photos")
    found = made.cameras.cameras
    place = fit_similarity(
        np.array([one.eye for one in found.values()]), np.array([cameras[name].eye for name in found])
    )
    marks = truth[ict().landmarks[17:]]
    of_photos, of_points = (
        scan_samples(scan, place, marks.min(axis=0), marks.max(axis=0), 1.0)
        for scan in (made.scan, replace(made.scan, photos=None))
    )
    assert of_photos.colors is not None
    assert of_points.colors is not None
    true = photo_booth.colors_at(truth, of_photos.points)
    off = [np.abs(np.log(np.maximum(colors, 0.01) / true)).mean() for colors in (of_photos.colors, of_points.colors)]
    assert off[0] < 0.6 * off[1]
