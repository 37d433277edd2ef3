"""Landmarks found on scans: true within bounds where truth is known, alike in every pose and unit, none of no face."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import done, exit_code, failed
from import_data import shared
from scan_actors import Actor, ict
from scan_simulator import ScanOptions, simulate
from solids import ball

from facepipe.core.errors import FitError
from facepipe.geometry.coarse_surface import Look, coarse_look, disc_look, filled_look, part_look, surface_look
from facepipe.geometry.face_crops import from_crop, turned_crop
from facepipe.geometry.landmarks import MIRRORED
from facepipe.geometry.pinhole import Pinhole, meeting_points
from facepipe.geometry.polygons import small_holes
from facepipe.importers.scan_file import read_scan
from facepipe.importers.scan_landmarks import read_scan_landmarks
from facepipe.pictures.surface_view import draw_surface
from facepipe.scanning.landmarks import FindScanLandmarks
from facepipe.scanning.landmarks.find import _Search
from facepipe.scanning.landmarks.search import (
    LEFT_EYE,
    MOUTH,
    RIGHT_EYE,
    FaceFrame,
    _apart,
    _middle_crop,
    axis_views,
    face_frame,
)
from facepipe.scanning.landmarks.where import looked_at
from facepipe.scans import Scan, ScanHints

RNG = np.random.default_rng


def turn(seed: int) -> np.ndarray:
    q, _ = np.linalg.qr(RNG(seed).standard_normal((3, 3)))
    return np.asarray(q * np.sign(np.linalg.det(q)))


def view(seed: int, size: int = 120) -> Pinhole:
    return Pinhole.around(RNG(seed).normal(size=3), turn(seed), 1.5, size)


# ---- views and rays


def test_rays_lead_back_to_what_was_seen() -> None:
    one, points = view(1), RNG(2).normal(size=(50, 3))
    pixels, depth = one.project(points)
    assert np.abs(one.eye + depth[:, None] * one.directions(pixels) - points).max() < 1e-9


def test_rays_meet_where_they_should_though_some_are_wrong() -> None:
    points = RNG(3).normal(size=(30, 3)) * 0.5
    views = [view(seed) for seed in range(9)]
    pixels = np.stack([one.project(points)[0] for one in views])
    pixels[:2] += 25.0  # pixels: two of nine views see something else
    directions = np.stack([one.directions(seen) for one, seen in zip(views, pixels, strict=True)])
    found, distances = meeting_points(np.stack([one.eye for one in views]), directions, np.ones((9, 30)), 0.01)
    assert np.abs(found - points).max() < 0.01
    assert (distances[:2] > 10 * distances[2:].max(axis=0)).all()


def test_one_ray_alone_gives_a_point_on_it() -> None:
    found, distances = meeting_points(np.zeros((1, 3)), np.array([[[0.0, 0, 1]]]), np.ones((1, 1)), 1.0)
    assert np.isfinite(found).all()
    assert distances.max() < 1e-6


# ---- surfaces to look at


def test_pictures_show_the_depth_of_a_ball() -> None:
    points, triangles = ball(40)
    one = replace(view(4), eye=5.0 * view(4).axes[2])
    picture, depth = draw_surface(surface_look(points, triangles, None), one)
    rows, columns = np.nonzero(np.isfinite(depth))
    places = one.eye + depth[rows, columns, None] * one.directions(np.c_[columns + 0.5, rows + 0.5])
    radii = np.linalg.norm(places, axis=1)
    assert np.median(np.abs(radii - 1)) < 0.01
    seen = np.hypot(columns + 0.5 - 60, rows + 0.5 - 60).max() / one.focal
    assert seen == pytest.approx(1 / np.sqrt(24), rel=0.03)  # of the cone that touches it
    assert ((picture >= 0) & (picture <= 1)).all()


def test_the_hollow_side_of_a_face_shows_no_features() -> None:
    points, triangles = ball(40)
    points = points * (1 + 0.05 * np.sin(9 * points[:, :1]))
    bowl = triangles[points[triangles][:, :, 2].max(axis=1) < 0]
    one = Pinhole.around(np.zeros(3), np.eye(3), 1.2, 100)
    hollow, face = (draw_surface(surface_look(points, one_side, None), one)[0] for one_side in (bowl, bowl[:, ::-1]))
    middle = slice(30, 70), slice(30, 70), 0
    assert np.ptp(hollow[middle]) < 0.01
    assert np.ptp(face[middle]) > 0.1


def test_coarse_surfaces_lie_within_a_cell_of_the_fine_one() -> None:
    points, triangles = ball(60)
    coarse = coarse_look(surface_look(points, triangles, np.abs(points)), 0.1)
    assert len(coarse.points) < len(points) / 4
    assert np.abs(np.linalg.norm(coarse.points, axis=1) - 1).max() < 0.1
    assert coarse.colors is not None
    assert np.abs(coarse.colors - np.abs(coarse.points)).max() < 0.1
    assert np.einsum("ni,ni->n", coarse.normals, coarse.points).min() > 0.9
    edges = np.sort(coarse.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] >= 2).all()  # no gaps


def test_discs_lie_across_the_normals() -> None:
    points, _ = ball(8)
    look = disc_look(points, points, np.full(len(points), 0.2), np.abs(points))
    corners = look.points.reshape(len(points), -1, 3)
    assert np.abs(np.linalg.norm(corners - points[:, None], axis=2) - 0.2).max() < 1e-12
    assert np.abs(np.einsum("nki,ni->nk", corners - points[:, None], points)).max() < 1e-12
    np.testing.assert_array_equal(look.normals, np.repeat(points, corners.shape[1], axis=0))
    np.testing.assert_array_equal(look.colors, np.abs(look.normals))
    a, b, c = look.points[look.triangles].transpose(1, 0, 2)
    assert (np.einsum("ti,ti->t", np.cross(b - a, c - a), a) > 0).all()


def holed(size: float) -> Look:
    """A ball without what is within `size` of its top, and without its lower half."""
    points, triangles = ball(40)
    top = np.linalg.norm(points - [0, 0, 1], axis=1) < size
    return surface_look(
        points, triangles[~top[triangles].any(axis=1) & (points[triangles][:, :, 2] > 0).all(axis=1)], None
    )


def test_small_holes_close_and_large_ones_stay() -> None:
    look = holed(0.3)
    assert len(small_holes(look.points, look.triangles, 0.2)) == 0
    closed = filled_look(look, 1.0)
    assert len(small_holes(closed.points, closed.triangles, 10.0)) == 1  # the lower border
    added = closed.triangles[len(look.triangles) :]
    a, b, c = closed.points[added].transpose(1, 0, 2)
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()  # outward, as the rest
    assert len(closed.points) == len(look.points) + 1


def test_crops_about_the_middle_turn_and_grow_about_it() -> None:
    middle = _middle_crop(40, 2.0, 8)
    pixels = np.array([[4.0, 4.0], [8.0, 4.0], [4.0, 0.0]])  # the middle, to its right, above it
    places = [[20, 20], [20, 28], [28, 20]]
    np.testing.assert_allclose(from_crop(pixels, turned_crop(middle, np.pi / 2, 1.0, 8)), places, atol=1e-12)
    twice = turned_crop(turned_crop(middle, 0.2, 1.0, 8), 0.3, 1.25, 8)
    np.testing.assert_allclose(twice, turned_crop(middle, 0.5, 1.25, 8), atol=1e-12)


def test_views_along_the_axes_look_both_ways_through_upright_squares() -> None:
    views = axis_views(np.zeros(3), 2.0)
    for view in views:
        np.testing.assert_allclose(view.axes @ view.axes.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(view.axes) == pytest.approx(1.0)
        np.testing.assert_allclose(view.eye, 10.0 * view.axes[2], atol=1e-12)
    np.testing.assert_allclose(sum(view.eye for view in views), np.zeros(3), atol=1e-12)


def test_the_surest_of_faces_at_one_place_is_kept() -> None:
    presences, places = (0.6, 0.9, 0.7, 0.8), (0.0, 0.0, 5.0, 9.0)
    frames = [FaceFrame(middle=np.array([x, 0.0, 0.0]), axes=np.eye(3), side=1.0) for x in places]
    faces = list(zip(presences, frames, strict=True))
    assert [presence for presence, _ in _apart(faces, 3)] == [0.9, 0.8, 0.7]
    assert [presence for presence, _ in _apart(faces, 2)] == [0.9, 0.8]


def test_a_part_of_a_surface_has_the_points_of_its_triangles() -> None:
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]])
    look = Look(points=corners, triangles=np.array([[0, 1, 2], [1, 3, 2]]), normals=corners + 1.0, colors=corners + 2.0)
    part = part_look(look, np.array([False, True, True, True]))
    assert part.triangles.tolist() == [[0, 2, 1]]
    for found, whole in ((part.points, look.points), (part.normals, look.normals), (part.colors, look.colors)):
        assert whole is not None
        np.testing.assert_array_equal(found, whole[1:])


# ---- faces


def test_the_frame_of_a_face_turns_with_it() -> None:
    points = ict().neutral[ict().landmarks]
    upright = face_frame(points)
    assert upright is not None
    assert np.degrees(np.arccos((np.trace(upright.axes) - 1) / 2)) < 3.0
    moved = face_frame(0.01 * points @ turn(5).T + 7.0)
    assert moved is not None
    assert np.abs(moved.axes - upright.axes @ turn(5).T).max() < 1e-9
    assert moved.side == pytest.approx(0.01 * upright.side)
    edges = upright.middle + 0.7 * upright.side * np.stack([-upright.axes[0], upright.axes[1]])
    pixels, _ = upright.view(0.0, 0.0, 200, 1.4).project(edges)  # 10 radii away: a sphere of this size just fits
    np.testing.assert_allclose(pixels, [[0, 100], [100, 0]], atol=1.0)
    assert face_frame(np.full((68, 3), np.nan)) is None
    assert face_frame(points * [1, 0, 0]) is None


def test_the_other_sides_landmarks_are_those_of_a_symmetric_face() -> None:
    points = ict().neutral[ict().landmarks]
    assert np.abs(points[MIRRORED] * [-1, 1, 1] - points).max() < 0.5  # mm
    assert [MIRRORED[one] for one in MIRRORED] == [*range(68)]


def finder() -> FindScanLandmarks:
    return FindScanLandmarks(draw=draw_surface)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_landmarks_of_simulated_scans_are_true(seed: int) -> None:
    """No colour, holes, any pose and unit: errors are those of brows that nobody sees, too."""
    truth = Actor(seed).neutral
    scan = simulate(truth, seed)
    found = finder()(Scan(name="actor", points=scan.points, triangles=scan.triangles))
    errors = np.linalg.norm(scan.pose.undo(found.landmarks.points) - truth[ict().landmarks], axis=1)
    assert found.report.found >= 60
    assert np.nanmean(errors[17:]) < 3.5  # mm
    assert np.nanmean(errors[:17]) < 7.5
    assert np.nanmax(errors) < 15.0
    expected = found.landmarks.sigma_mm * np.sqrt(3.0)  # of three coordinates
    assert 0.5 < np.sqrt(np.nanmean((errors / expected) ** 2)) < 1.5


@pytest.mark.slow
def test_a_mask_has_no_jaw_where_it_ends() -> None:
    """The outline of a piece of a face is not its jaw: what is kept is as true as on the whole head."""
    truth = Actor(2).neutral
    landmarks = truth[ict().landmarks]
    scan = simulate(truth, 2, ScanOptions(moved=False))
    kept = np.linalg.norm(scan.points - landmarks[30], axis=1) < 80.0
    triangles = scan.triangles[kept[scan.triangles].all(axis=1)]
    found = finder()(Scan(name="mask", points=scan.points, triangles=triangles))
    errors = np.linalg.norm(found.landmarks.points - landmarks, axis=1)
    assert np.isnan(errors[:17]).sum() > 6
    assert np.nanmean(errors[17:]) < 4.0
    assert np.nanmax(errors) < 15.0
    assert any("ends" in line for line in found.report.warnings)


@pytest.mark.slow
def test_the_real_scan_has_the_same_landmarks_in_every_pose_and_unit() -> None:
    scan = read_scan(shared("scans/LeePerrySmith.glb"))
    found = finder()(scan)
    points = found.landmarks.points
    eyes = np.linalg.norm(points[36] - points[45])
    assert found.report.presence > 0.99
    left, right, mouth = points[42:48].mean(axis=0), points[36:42].mean(axis=0), points[48:].mean(axis=0)
    assert left[0] > 0.1 * eyes > -0.1 * eyes > right[0]  # +X is the subject's left, +Y up
    assert (left + right)[1] / 2 > mouth[1] + 0.5 * eyes
    assert points[30, 2] > points[[27, 36, 45], 2].max()  # the tip of the nose is in front
    moved = replace(scan, points=40.0 * scan.points @ turn(6).T + [3.0, -900.0, 20.0])
    again = (finder()(moved).landmarks.points - [3.0, -900.0, 20.0]) / 40.0 @ turn(6)
    assert np.nanmean(np.linalg.norm(again - points, axis=1)) < 0.015 * eyes


class NoFace:
    """A network that sees none, or one everywhere in its map alone, and counts what it looks at."""

    size, cell = 8, 4

    def __init__(self, level: float = -9.0) -> None:
        self.level, self.maps, self.crops = level, 0, 0

    def __call__(self, crops: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        self.crops += len(crops)
        return np.zeros((len(crops), 68, 2)), np.full(len(crops), 0.2)

    def presence_map(self, level: np.ndarray) -> np.ndarray:
        self.maps += 1
        rows, columns = (length // self.cell - 1 for length in level.shape[1:])
        return np.full((rows, columns), self.level)


@pytest.mark.parametrize("level", [-9.0, 9.0])
def test_the_search_ends_where_there_is_no_face_and_says_what_was_tried(level: float) -> None:
    network, (points, triangles) = NoFace(level), ball(12)
    scan = Scan(name="ball", points=points, triangles=triangles, colors=np.abs(points))

    def blank(look: Look, view: Pinhole) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros((view.size, view.size, 3)), np.ones((view.size, view.size))

    search = _Search(surface=looked_at(scan), scan=scan, draw=blank, network=network)
    with pytest.raises(FitError, match=r"^ball: no face found on it in \d+ pictures in colours and clay"):
        search.face()
    assert 0 < network.maps < 5 * 1000  # sizes of crops, and the budget
    assert network.crops <= 24 * search.counted.pictures
    assert network.crops == 0 or level > 0


def with_balls(scan: Scan, *balls: tuple[tuple[float, float, float], tuple[float, float, float]]) -> Scan:
    """The scan and balls, pieces of their own, with colours that number points, as masks do."""
    points, triangles, piece = [scan.points], [scan.triangles], [np.zeros(len(scan.triangles), np.int32)]
    for number, (middle, radii) in enumerate(balls, 1):
        own, corners = ball(20)
        triangles.append((corners + sum(len(one) for one in points)).astype(np.int32))
        points.append(own * radii + np.array(middle))
        piece.append(np.full(len(corners), number, np.int32))
    every = np.concatenate(points)
    names = ("head", *(f"ball{number}" for number in range(len(balls))))
    return replace(
        scan,
        points=every,
        triangles=np.concatenate(triangles),
        colors=RNG(0).random(every.shape),
        hints=ScanHints(pieces=names, piece=np.concatenate(piece)),
    )


def bald(seed: int) -> tuple[Scan, np.ndarray]:
    """A head with holes, in mm, upright, and its landmarks (68, 3)."""
    truth = Actor(seed).neutral
    scan = simulate(truth, seed, ScanOptions(moved=False))
    return Scan(name="actor", points=scan.points, triangles=scan.triangles), truth[ict().landmarks]


TORSO = ((0.0, -800.0, -60.0), (200.0, 620.0, 120.0))
ARMS = ((0.0, -380.0, -60.0), (800.0, 60.0, 60.0))


@pytest.mark.slow
@pytest.mark.parametrize("hidden", [False, True])
def test_the_face_of_a_body_is_found_by_whatever_hides_it(hidden: bool) -> None:
    """Lying on its back, in metres, far from the origin, its colours are no colours; in a helmet, or without."""
    head, landmarks = bald(3)
    balls = (TORSO, ARMS, ((0.0, 20.0, -20.0), (210.0, 210.0, 210.0)))[: 3 if hidden else 2]
    scan = with_balls(head, *balls)
    lying, far = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), np.array([300.0, -200.0, 5.0])
    found = finder()(replace(scan, points=0.001 * scan.points @ lying.T + far))
    errors = np.linalg.norm((found.landmarks.points - far) @ lying * 1000.0 - landmarks, axis=1)
    assert found.report.found >= 60
    assert np.nanmean(errors[17:]) < 4.0  # mm
    assert np.nanmean(errors[:17]) < 7.5
    assert found.report.seen == "clay"
    assert found.report.pieces == ("head",)
    assert found.carrier[: len(head.points)].mean() > 0.9
    assert not found.carrier[len(head.points) :].any()
    assert not found.report.unit_known
    assert found.report.mm_per_unit == pytest.approx(1000.0, rel=0.15)


@pytest.mark.slow
def test_of_two_heads_neither_is_taken_until_one_is_named() -> None:
    (first, landmarks), (second, _) = bald(1), bald(2)
    triangles = np.concatenate([first.triangles, second.triangles + len(first.points)]).astype(np.int32)
    piece = np.repeat([0, 1], [len(first.triangles), len(second.triangles)]).astype(np.int32)
    scan = Scan(
        name="crowd",
        points=np.concatenate([first.points, second.points + np.array([400.0, 0, 0])]),
        triangles=triangles,
        hints=ScanHints(pieces=("Anna", "Bert"), piece=piece),
    )
    with pytest.raises(FitError, match=r"^crowd: 2 faces, at \(.*\) and \(.*\): expected one, .* --component$"):
        finder()(scan)
    found = replace(finder(), component="Anna")(scan)
    assert np.nanmean(np.linalg.norm(found.landmarks.points - landmarks, axis=1)[17:]) < 4.0
    assert found.report.pieces == ("Anna",)


@pytest.mark.slow
def test_shapes_of_eyes_and_mouth_spare_the_search_and_tell_a_mirrored_mesh() -> None:
    head, landmarks = bald(1)
    features = np.stack([landmarks[part].mean(axis=0) for part in (LEFT_EYE, RIGHT_EYE, MOUTH)])
    scan = replace(with_balls(head, TORSO), colors=None)
    hints = replace(scan.hints, features=features, swapped=True, mm_per_unit=10.0)
    found = finder()(replace(scan, hints=hints))
    assert found.report.searched == 0
    assert np.nanmean(np.linalg.norm(found.landmarks.points - landmarks, axis=1)[17:]) < 4.0
    said = " ".join(found.report.warnings)
    assert "mirrored" in said
    assert "its unit may be wrong" in said  # ten times as large as it can be


@pytest.mark.slow
def test_a_face_that_is_painted_on_an_egg_is_said_to_be_painted() -> None:
    head = read_scan(shared("scans/LeePerrySmith.glb"))
    high = float(np.ptp(head.points[:, 1]))
    middle = (head.points.min(axis=0) + head.points.max(axis=0)) / 2
    front = Pinhole.around(middle, np.eye(3), 0.6 * high, 300, distance=30.0)
    picture, _ = draw_surface(surface_look(head.points, head.triangles, None), front)
    own, triangles = ball(150)
    points = own * np.array([0.36, 0.5, 0.4]) * high + middle
    column, row = np.clip(front.project(points)[0].astype(int), 0, 299).T
    paint = np.where(own[:, 2:] > 0, picture[row, column] ** 2.2, 0.3)
    found = finder()(Scan(name="egg", points=points, triangles=triangles, colors=paint))
    assert found.report.painted
    assert found.report.seen == "colours"
    assert any("painted" in line for line in found.report.warnings)


@pytest.mark.slow
def test_what_shows_no_face_is_reported() -> None:
    scan = read_scan(shared("scans/LeePerrySmith.glb"))
    back = scan.triangles[(scan.points[scan.triangles][:, :, 2] < 0).all(axis=1)]
    with pytest.raises(FitError, match="back: no face found"):
        finder()(replace(scan, name="back", triangles=back))


@pytest.mark.slow
def test_the_command_writes_a_file_that_reads_back(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from PIL import Image

    out, picture = tmp_path / "scan.landmarks.json", tmp_path / "scan.png"
    words = ["scan-landmarks", str(shared("scans/LeePerrySmith.glb")), "-o", str(out), "--picture", str(picture)]
    report = json.loads(done(capsys, *words, "--json", quiet=False))
    assert report["found"] == read_scan_landmarks(out).known.sum() == 68
    assert read_scan_landmarks(out).sigma_mm.tolist() == [3.5] * 17 + [1.5] * 10 + [0.8] * 41
    assert (report["place"], report["seen"], report["pieces"]) == ("all of it", "clay", ["LeePerrySmith"])
    pixels = np.asarray(Image.open(picture).convert("RGB")).astype(int)
    assert ((pixels[..., 0] > 200) & (pixels[..., 1] < 80)).sum() > 68 * 20  # its red dots
    assert exit_code(*words) == 2  # it exists now


@pytest.mark.slow
def test_a_file_without_unit_is_said_to_be_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    head, _ = bald(1)
    rows = [f"v {x:.6g} {y:.6g} {z:.6g}" for x, y, z in head.points / 25.4]
    rows += ["o head", *(f"f {a} {b} {c}" for a, b, c in head.triangles + 1)]
    (tmp_path / "head.obj").write_text("\n".join(rows))
    words = ["scan-landmarks", str(tmp_path / "head.obj"), "-o", str(tmp_path / "x.json")]
    refused = failed(capsys, *words, "--component", "body", folder=tmp_path)
    assert "no component 'body', expected the name of one: head" in refused
    assert exit_code(*words, "--component", "head") in (0, 1)
    assert "the file has no unit: by the size of the face one of 2" in capsys.readouterr().out


def test_bad_lines_are_refused_before_any_work(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "scan.ply").write_bytes(b"ply\nnothing")
    for words in (["absent.ply", "-o", "x.json"], ["scan.ply", "-o", "x.json"], ["scan.ply", "-o", "scan.ply"]):
        places = [str(tmp_path / word) if "." in word else word for word in words]
        assert str(tmp_path) in failed(capsys, "scan-landmarks", *places, folder=tmp_path)
