"""Scans of rendered photos against the head that they show."""

from __future__ import annotations

import contextlib
import io
import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import photo_booth
import pytest
from command_line import exit_code, failed
from photo_booth import noise_photos
from scan_actors import Actor, ict
from scan_simulator import visible_triangles

from facepipe.core.errors import FitError
from facepipe.geometry.closest_points import closest_places
from facepipe.geometry.similarity import Similarity, fit_similarity
from facepipe.importers.scan_landmarks import read_scan_landmarks
from facepipe.importers.scan_ply import read_ply
from facepipe.scanning.photos import (
    Cameras,
    PhotoCamera,
    ScanPhotos,
    read_cameras,
    write_cameras,
)

FloatArray = npt.NDArray[np.floating]

MARKERS = (27, 30, 36, 45, 48, 54)  # landmarks where the actor has dots


@pytest.mark.needs_scan
def test_photos_without_overlap_are_refused(tmp_path: Path) -> None:
    noise_photos(tmp_path / "photos", 5, (256, 256))
    with pytest.raises(FitError, match="degrees apart") as caught:
        ScanPhotos()(tmp_path / "photos")
    assert "\n" not in str(caught.value)


@dataclass(frozen=True, kw_only=True)
class Session:
    """Photos of an actor, and what facepipe made of them on the command line."""

    folder: Path  # holds photos/, scan.ply, scan.landmarks.json, rig.json
    truth: FloatArray  # (n, 3) ICT points, millimetres
    cameras: dict[str, PhotoCamera]
    report: dict[str, Any]
    warnings: str


def session(folder: Path, cameras: dict[str, PhotoCamera], flags: list[str], *, stray: bool = False) -> Session:
    """An actor by `cameras` (photos may be there already), scanned. `stray`: with one of something else, and a note."""
    truth = Actor(5).neutral
    if not (folder / "photos").exists():
        photo_booth.take_photos(folder / "photos", truth, cameras)
    if stray:
        noise_photos(folder / "other", 1, (480, 576))[0].rename(folder / "photos" / "stray.png")
        (folder / "photos" / "note.txt").write_text("taken on a Tuesday")
    dots = truth[ict().landmarks[list(MARKERS)]]
    sightings = {
        name: {f"dot{mark}": place for mark, place in zip(MARKERS, one.project(dots).tolist(), strict=True)}
        for name, one in list(cameras.items())[1:4]
    }
    (folder / "markers.json").write_text(json.dumps({"photos": sightings}))
    words = ["scan", str(folder / "photos"), "-o", str(folder / "scan.ply"), "--markers", str(folder / "markers.json")]
    words += ["--save-cameras", str(folder / "rig.json"), "--json", *flags]
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        assert exit_code(*words) == 0, err.getvalue()
    return Session(
        folder=folder, truth=truth, cameras=cameras, report=json.loads(out.getvalue()), warnings=err.getvalue()
    )


def surface_errors(one: Session, place: Similarity) -> FloatArray:
    """(k,) distances in millimetres of points of the scan, placed, from the head."""
    points = place.apply(read_ply(one.folder / "scan.ply").points)
    points = points[np.random.default_rng(0).permutation(len(points))[:6000]]
    places = closest_places(points, one.truth, photo_booth.solid_triangles()).places
    return np.asarray(np.linalg.norm(places - points, axis=1))


def placement(one: Session) -> Similarity:
    """What lays the cameras that were found onto the true ones."""
    found = read_cameras(one.folder / "rig.json").cameras
    return fit_similarity(
        np.array([camera.eye for camera in found.values()]), np.array([one.cameras[name].eye for name in found])
    )


@pytest.mark.needs_scan
@pytest.mark.slow
def test_a_scan_is_the_head_that_the_photos_show(tmp_path: Path) -> None:
    """Six small photos and one of something else; nothing is known but how far two markers are apart."""
    cameras = photo_booth.ring((-31, -18, -6, 6, 18, 31), [0], width=480, height=576)
    corners = Actor(5).neutral[ict().landmarks[[36, 45]]]
    apart = float(np.linalg.norm(corners[0] - corners[1]))
    flags = ["--no-landmarks", "--neighbours", "3", "--marker-distance", "dot36", "dot45", f"{apart:.4f}"]
    one = session(tmp_path, cameras, flags, stray=True)
    errors = surface_errors(one, placement(one))
    assert np.median(errors) < 0.7
    assert np.percentile(errors, 95) < 2.0
    says_what_was_not_used(one)
    is_in_millimetres(one)
    has_markers_where_they_were_painted(one)
    has_the_colours_of_the_skin(one)


def says_what_was_not_used(one: Session) -> None:
    assert one.report["photos_unused"] == ["stray.png"]
    assert len(one.report["photos_used"]) == 6
    assert "stray.png" in one.warnings
    assert "note.txt" in one.warnings
    assert one.report["reprojection_px"] < 0.5


def is_in_millimetres(one: Session) -> None:
    assert one.report["unit"] == "mm"
    assert placement(one).scale == pytest.approx(1.0, abs=0.01)


def has_markers_where_they_were_painted(one: Session) -> None:
    markers = read_scan_landmarks(one.folder / "scan.landmarks.json").markers
    assert sorted(markers) == sorted(f"dot{mark}" for mark in MARKERS)
    found = placement(one).apply(np.array([markers[f"dot{mark}"] for mark in MARKERS]))
    assert np.linalg.norm(found - one.truth[ict().landmarks[list(MARKERS)]], axis=1).max() < 1.5


def has_the_colours_of_the_skin(one: Session) -> None:
    scan = read_ply(one.folder / "scan.ply")
    assert scan.normals is not None
    assert scan.colors is not None
    places = placement(one).undo(one.truth[ict().landmarks[[51, 57, 27, 30]]])
    green, red = np.array([scan.colors[np.argmin(np.linalg.norm(scan.points - place, axis=1))] for place in places]).T[
        [1, 0]
    ]
    assert (green / red)[:2].max() < (green / red)[2:].min()  # painted lips are redder than the nose


def test_scans_do_not_overwrite(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    noise_photos(tmp_path / "photos", 5)
    words = ["scan", str(tmp_path / "photos"), "-o"]
    for name in ("a.ply", "b.landmarks.json", "rig.json"):
        (tmp_path / name).write_text("kept")
    assert "a.ply: exists" in failed(capsys, *words, tmp_path / "a.ply", folder=tmp_path)
    assert "b.landmarks.json: exists" in failed(capsys, *words, tmp_path / "b.ply", folder=tmp_path)
    err = failed(capsys, *words, tmp_path / "c.ply", "--save-cameras", tmp_path / "rig.json", folder=tmp_path)
    assert "rig.json: exists" in err
    markers = ("--markers", tmp_path / "b.landmarks.json", "--force")
    assert "b.landmarks.json: is an input" in failed(capsys, *words, tmp_path / "b.ply", *markers, folder=tmp_path)
    apart = ("--marker-distance", "chin", "brow", "far")
    err = failed(capsys, *words, tmp_path / "c.ply", *apart, folder=tmp_path)
    assert "--marker-distance chin brow far: expected two markers and millimetres" in err
    assert "'.obj', expected .ply" in failed(capsys, *words, tmp_path / "new.obj", folder=tmp_path)
    assert all((tmp_path / name).read_text() == "kept" for name in ("a.ply", "b.landmarks.json", "rig.json"))


@pytest.mark.needs_scan
@pytest.mark.slow
def test_the_same_photos_give_the_same_bytes(tmp_path: Path) -> None:
    cameras = photo_booth.ring((-31, -18, -6, 6, 18, 31), [0], width=320, height=384)
    photo_booth.take_photos(tmp_path / "photos", Actor(5).neutral, cameras)
    for name in ("a", "b"):
        shutil.copytree(tmp_path / "photos", tmp_path / name / "photos")
        session(tmp_path / name, cameras, ["--no-landmarks"])
    for file in ("scan.ply", "scan.landmarks.json", "rig.json"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def many_cameras() -> dict[str, PhotoCamera]:
    """Ten cameras within 55 degrees to either side."""
    ring = photo_booth.ring(np.linspace(-55, 55, 7).tolist(), [0], width=720, height=864)
    above = photo_booth.ring([-28, 28], [20], width=720, height=864)
    below = photo_booth.ring([0], [-18], width=720, height=864)
    return {f"{i:02d}.png": one for i, one in enumerate([*ring.values(), *above.values(), *below.values()])}


@pytest.fixture(scope="module")
def many_photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The actor from all of them."""
    folder = tmp_path_factory.mktemp("photos")
    photo_booth.take_photos(folder, Actor(5).neutral, many_cameras())
    return folder


@pytest.mark.needs_scan
@pytest.mark.needs_torch
@pytest.mark.slow
def test_cameras_withheld_the_scan_is_within_a_millimetre(many_photos: Path, tmp_path: Path) -> None:
    shutil.copytree(many_photos, tmp_path / "photos")
    one = session(tmp_path, many_cameras(), [])
    errors = surface_errors(one, placement(one))
    assert np.median(errors) < 0.3
    assert np.percentile(errors, 95) < 1.0
    assert coverage(one, placement(one)) > 0.85
    assert one.report["unit"] is None
    has_landmarks(one)


def has_landmarks(one: Session) -> None:
    found = read_scan_landmarks(one.folder / "scan.landmarks.json")
    assert found.known[17:].mean() > 0.8
    assert not found.known[:17].any()
    error = placement(one).apply(found.points[found.known]) - one.truth[ict().landmarks[found.known]]
    assert np.median(np.linalg.norm(error, axis=1)) < 4.0


def coverage(one: Session, place: Similarity) -> float:
    """Share of the visible points of the narrow face that the scan is within a millimetre of."""
    scan = read_ply(one.folder / "scan.ply")
    seen = np.unique(visible_triangles(one.truth))
    face = one.truth[seen[seen < ict().narrow_face]]
    nearest = closest_places(face, place.apply(scan.points), np.asarray(scan.triangles)).places
    return float((np.linalg.norm(nearest - face, axis=1) < 1.0).mean())


@pytest.mark.needs_scan
@pytest.mark.slow
def test_known_cameras_keep_their_coordinates(many_photos: Path, tmp_path: Path) -> None:
    cameras = many_cameras()
    shutil.copytree(many_photos, tmp_path / "photos")
    write_cameras(tmp_path / "known.json", Cameras(cameras=cameras, unit="mm"))
    one = session(tmp_path, cameras, ["--no-landmarks", "--cameras", str(tmp_path / "known.json")])
    where_it_is = Similarity(rotation=np.eye(3), translation=np.zeros(3))
    errors = surface_errors(one, where_it_is)
    assert np.median(errors) < 0.3
    assert np.percentile(errors, 95) < 1.0
    assert coverage(one, where_it_is) > 0.85
    assert one.report["unit"] == "mm"
