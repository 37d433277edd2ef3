"""Geometry of scans from photos: lenses, rectified pairs, depth, markers, the cloud and its surface."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path
from unittest import mock
from unittest.mock import DEFAULT

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from photo_booth import camera_at
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from facepipe.core.errors import FitError
from facepipe.geometry.similarity import Similarity
from facepipe.scanning.photos import (
    PhotoCamera,
    ScanPhotosOptions,
    triangulate,
)
from facepipe.scanning.photos.depth import RectifiedView, _sampled, depth_map, disparities, rectify
from facepipe.scanning.photos.photos import Photo
from facepipe.scanning.photos.structure import (
    Structure,
    _structure,
    _triangulated,
    choose_pairs,
    colmap_module,
    find_structure,
    find_subject,
    move_camera,
    upright,
)
from facepipe.scanning.photos.surface import Cloud, _normals, clean, make_surface

FloatArray = npt.NDArray[np.floating]

LENS = (-0.11, 0.05, 0.002, -0.003)


def turned(axis: FloatArray) -> FloatArray:
    """(3, 3) rotation about (3,) by its length in radians."""
    return np.asarray(Rotation.from_rotvec(axis).as_matrix())


@pytest.mark.needs_scan
def test_cameras_project_as_opencv_does() -> None:
    import cv2

    camera = camera_at(np.array([120.0, 60.0, 700.0]), 0.4, distortion=LENS)
    points = np.random.default_rng(0).uniform(-80, 80, (50, 3))
    rotation = cv2.Rodrigues(camera.rotation)[0]
    expected, _ = cv2.projectPoints(points, rotation, camera.translation, camera.matrix, np.array(camera.distortion))
    np.testing.assert_allclose(camera.project(points), expected[:, 0], atol=1e-8)


@settings(max_examples=30, deadline=None)
@given(st.floats(-0.3, 0.3), st.floats(-0.1, 0.1), st.floats(-0.01, 0.01))
def test_rays_undo_the_lens(k1: float, k2: float, p: float) -> None:
    camera = camera_at(np.array([0.0, 0.0, 700.0]), distortion=(k1, k2, p, -p))
    pixels = np.random.default_rng(1).uniform((0, 0), (640, 800), (40, 2))
    np.testing.assert_allclose(camera.bend(camera.rays(pixels)) * camera.focal + camera.center, pixels, atol=1e-6)


def test_points_behind_a_camera_show_nowhere() -> None:
    assert np.isnan(camera_at(np.array([0.0, 0.0, 700.0])).project(np.array([[0.0, 0.0, 900.0]]))).all()


def test_a_resized_photo_shows_the_same() -> None:
    camera = camera_at(np.array([90.0, 0.0, 700.0]), distortion=LENS)
    points = np.random.default_rng(2).uniform(-80, 80, (20, 3))
    np.testing.assert_allclose(camera.scaled(320, 400).project(points) * 2, camera.project(points), atol=1e-9)


def test_cameras_move_with_what_they_see() -> None:
    camera = camera_at(np.array([90.0, -200.0, 700.0]), 0.2, distortion=LENS)
    by = Similarity(rotation=turned(np.array([0.3, -1.1, 0.4])), translation=np.array([5.0, -3.0, 8.0]), scale=0.03)
    points = np.random.default_rng(3).uniform(-80, 80, (20, 3))
    np.testing.assert_allclose(move_camera(camera, by).project(by.apply(points)), camera.project(points), atol=1e-8)


EYES = [((-90, 0, 700), (90, 20, 690)), ((90, 0, 700), (-90, 20, 690)), ((20, -100, 700), (0, 120, 650))]


@pytest.mark.parametrize(("first", "second"), EYES)
def test_rectified_photos_show_a_point_in_one_row(first: tuple[int, ...], second: tuple[int, ...]) -> None:
    a, b = camera_at(np.array(first, float), 0.1), camera_at(np.array(second, float), -0.05)
    points = np.random.default_rng(4).uniform(-80, 80, (200, 3))
    pair, swapped = rectify(a, b, points)
    left, right = (b, a) if swapped else (a, b)
    in_left, ahead = pair.left.pixels(left.to_camera(points))
    in_right, _ = pair.right.pixels(right.to_camera(points))
    np.testing.assert_allclose(in_left[:, 1], in_right[:, 1], atol=1e-8)
    disparity = in_left[:, 0] - in_right[:, 0]
    np.testing.assert_allclose(pair.depth(disparity), ahead, rtol=1e-9)
    assert (disparity > pair.lowest).all()
    assert (disparity < pair.lowest + pair.count).all()
    assert (in_left > 0).all()
    assert (in_left < pair.size).all()
    assert (in_right > 0).all()
    assert (in_right < pair.size).all()


@pytest.mark.needs_scan
def test_a_view_that_is_the_photos_own_shows_the_photo() -> None:
    camera = camera_at(np.array([0.0, 0.0, 700.0]), width=32, height=24, focal=(64.0, 64.0), center=(16.0, 12.0))
    photo = np.random.default_rng(15).integers(0, 256, (24, 32, 3), np.uint8)
    own = RectifiedView(camera=camera, turn=np.eye(3), focal=64.0, origin=np.array([16.0, 12.0]))
    np.testing.assert_array_equal(own.picture(photo, (32, 24)), photo)


@pytest.mark.needs_scan
@pytest.mark.parametrize(("first", "second"), EYES)
def test_photos_of_a_plane_give_its_depth(first: tuple[int, ...], second: tuple[int, ...]) -> None:
    cameras = [camera_at(np.array(eye, float), distortion=LENS).scaled(400, 500) for eye in (first, second)]
    normal, offset = np.array([0.25, 0.1, 1.0]), 12.0  # of the plane normal . x = offset
    photos, truth = zip(*(plane_photo(camera, normal, offset) for camera in cameras), strict=True)
    corners = np.array([[x, y, (offset - 0.25 * x - 0.1 * y)] for x in (-100.0, 100.0) for y in (-100.0, 100.0)])
    pair, swapped = rectify(*cameras, np.r_[corners, corners * [0.1, 0.1, 1.0]])
    order = (1, 0) if swapped else (0, 1)
    found = disparities(pair, photos[order[0]], photos[order[1]])
    for number, view, disparity in zip(order, (pair.left, pair.right), found, strict=True):
        rays = np.column_stack([cameras[number].rays(pixel_middles(cameras[number])), np.ones(400 * 500)])
        depth = depth_map(pair, view, disparity, rays)
        near = (np.abs(rays[:, :2]) < 0.1).all(axis=1)
        error = (depth - truth[number])[near]
        assert np.isfinite(error).mean() > 0.9
        assert np.nanmedian(np.abs(error)) < 0.4  # of 700 away; a pixel of disparity is 2.9
        assert np.nanpercentile(np.abs(error), 95) < 1.6


def pixel_middles(camera: PhotoCamera) -> FloatArray:
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    return np.stack([columns.ravel(), rows.ravel()], axis=1)


def plane_photo(camera: PhotoCamera, normal: FloatArray, offset: float) -> tuple[npt.NDArray[np.uint8], FloatArray]:
    """A photo of a painted plane, and the depth (h * w,) of its pixels."""
    from scipy.ndimage import gaussian_filter, map_coordinates

    rays = np.column_stack([camera.rays(pixel_middles(camera)), np.ones(camera.width * camera.height)])
    world = rays @ camera.rotation
    depth = (offset - normal @ camera.eye) / (world @ normal)
    places = camera.eye + depth[:, None] * world
    noise = gaussian_filter(np.random.default_rng(5).standard_normal((256, 256)), 0.8, mode="wrap")
    tone = map_coordinates(noise / noise.std(), places[:, :2].T, order=1, mode="grid-wrap")
    grey = np.clip(128 + 40 * tone, 0, 255).astype(np.uint8).reshape(camera.height, camera.width)
    return np.repeat(grey[..., None], 3, axis=2), depth


def put_matches(folder: Path, cameras: dict[str, PhotoCamera], points: FloatArray) -> None:
    """A database of photos (below ``photos``, by name) that all show all points."""
    colmap = colmap_module()
    database = colmap.Database.open(folder / "matches.db")
    images = []
    for name, camera in cameras.items():
        params = [*camera.focal, *camera.center, *camera.distortion]
        lens = colmap.Camera(model="OPENCV", width=camera.width, height=camera.height, params=params)
        lens.camera_id = database.write_camera(lens)
        rig, frame = colmap.Rig(), colmap.Frame()
        rig.add_ref_sensor(lens.sensor_id)
        frame.rig_id = database.write_rig(rig)
        images.append(database.write_image(colmap.Image(name=name, camera_id=lens.camera_id)))
        frame.add_data_id(colmap.data_t(lens.sensor_id, images[-1]))
        database.write_frame(frame)
        database.write_keypoints(images[-1], camera.project(points).astype(np.float32))
    pair = colmap.TwoViewGeometry()
    pair.config = colmap.TwoViewGeometryConfiguration.CALIBRATED
    pair.inlier_matches = np.arange(len(points), dtype=np.uint32)[:, None].repeat(2, axis=1)
    for first, second in combinations(images, 2):
        database.write_matches(first, second, pair.inlier_matches)
        database.write_two_view_geometry(first, second, pair)
    database.close()


@pytest.mark.needs_scan
def test_matches_of_known_cameras_are_places_and_the_cameras_stay(tmp_path: Path) -> None:
    across = (-200.0, -100.0, 0.0, 100.0, 200.0)
    cameras = {f"{x:.0f}.png": camera_at(np.array([x, 0.2 * x, 700.0]), 0.001 * x, distortion=LENS) for x in across}
    points = np.random.default_rng(14).uniform(-80, 80, (30, 3))
    put_matches(tmp_path, cameras, points)
    (tmp_path / "photos").mkdir()
    model = _triangulated(colmap_module(), tmp_path, cameras, ScanPhotosOptions())
    found = _structure(model, {name: name for name in cameras}, len(cameras))
    assert found.points.shape == points.shape
    assert cKDTree(points).query(found.points)[0].max() < 0.01
    assert found.seen.all()
    for name, camera in cameras.items():
        np.testing.assert_allclose(found.cameras[name].project(points), camera.project(points), atol=1e-6)


@pytest.mark.needs_scan
def test_each_photo_of_a_known_camera_has_a_lens_of_its_own() -> None:
    pixels = np.zeros((8, 8, 3), np.uint8)
    photos = [Photo(name=name, pixels=pixels, full_size=(8, 8)) for name in ("a.png", "b.png")]
    known = {photo.name: camera_at(np.array([0.0, 0.0, 700.0])) for photo in photos}
    module = "facepipe.scanning.photos.structure"
    folders = []
    for cameras in (known, None):
        with mock.patch.multiple(
            module, colmap_module=DEFAULT, _match=DEFAULT, _triangulated=DEFAULT, _structure=DEFAULT
        ) as to:
            to["colmap_module"].return_value.incremental_mapping.return_value = {0: mock.Mock()}
            find_structure(photos, ScanPhotosOptions(lens="shared"), cameras)
        folders.append([file.split("/")[0] for file in to["_structure"].call_args.args[1]])
    assert folders == [["0000", "0001"], ["0000", "0000"]]


def structure_of(cameras: dict[str, PhotoCamera], points: FloatArray) -> Structure:
    return Structure(cameras=cameras, points=points, seen=np.ones((len(cameras), len(points)), bool), error=0.1)


def test_what_cameras_do_not_look_at_is_left_out() -> None:
    rng = np.random.default_rng(6)
    cameras = {f"{i}": camera_at(np.array([120.0 * i - 240, 30.0, 700.0])) for i in range(5)}
    head, wall = rng.normal(0, 40, (300, 3)), rng.normal(0, 200, (300, 3)) - [0, 0, 1500]
    subject, kept = find_subject(structure_of(cameras, np.r_[head, wall]))
    assert np.linalg.norm(subject.center) < 15
    np.testing.assert_array_equal(kept.points, head)


def test_pairs_are_neighbours() -> None:
    yaws = np.radians(np.arange(-60, 61, 15))
    cameras = {f"{i}": camera_at(700 * np.array([np.sin(y), 0.0, np.cos(y)])) for i, y in enumerate(yaws)}
    structure = structure_of(cameras, np.random.default_rng(7).normal(0, 40, (100, 3)))
    pairs = choose_pairs(structure, find_subject(structure)[0], 2)
    assert pairs == sorted({(i, i + 1) for i in range(8)} | {(0, 2), (6, 8)})


def test_photos_from_one_place_are_refused() -> None:
    cameras = {f"{i}": camera_at(np.array([0.1 * i, 0.0, 700.0])) for i in range(6)}
    structure = structure_of(cameras, np.random.default_rng(7).normal(0, 40, (100, 3)))
    with pytest.raises(FitError, match="degrees apart"):
        choose_pairs(structure, find_subject(structure)[0], 2)


def test_scans_without_known_cameras_stand_upright_and_face_z() -> None:
    tilt = Similarity(rotation=turned(np.array([2.0, 0.5, -1.0])), translation=np.array([9.0, 8.0, 7.0]), scale=0.01)
    ring = {f"{i}": camera_at(np.array([150.0 * i - 300, 40.0, 700.0])) for i in range(5)}
    points = np.random.default_rng(8).normal(0, 40, (60, 3))
    moved = structure_of({name: move_camera(one, tilt) for name, one in ring.items()}, tilt.apply(points))
    subject, moved = find_subject(moved)
    found, ball = upright(moved, subject, 100.0)
    eyes = np.array([camera.eye for camera in found.cameras.values()])
    right, down = (np.array([camera.rotation[row] for camera in found.cameras.values()]).mean(axis=0) for row in (0, 1))
    assert eyes[:, 2].min() > 100
    assert np.ptp(eyes[:, 1]) < 0.2 * np.ptp(eyes[:, 0])
    assert right[0] > 0.8
    assert down[1] < -0.8
    assert ball.radius == 100
    assert not ball.center.any()


def test_disparities_are_interpolated_but_not_across_an_edge() -> None:
    disparity = np.array([[1.0, 2.0, 4.5, 4.5], [1.0, 3.0, 4.5, np.nan]])
    between = np.array([[0.5, 0.5], [1.5, 0.5], [2.5, 0.5], [-0.5, 0.5]])  # smooth, an edge, unknown, outside
    np.testing.assert_array_equal(_sampled(disparity, between), [1.75, np.nan, np.nan, np.nan])


def test_markers_are_placed_in_spite_of_wrong_sightings() -> None:
    rng = np.random.default_rng(9)
    cameras = [camera_at(np.array([150.0 * i - 450, 80.0 * (i % 2), 700.0]), distortion=LENS) for i in range(7)]
    place = np.array([12.0, -30.0, 44.0])
    pixels = np.concatenate([camera.project(place[None]) for camera in cameras]) + rng.normal(0, 0.3, (7, 2))
    pixels[[1, 4]] += [[60.0, -20.0], [-15.0, 90.0]]
    found = triangulate(cameras, pixels, 2.0, least=3)
    assert found is not None
    assert np.linalg.norm(found - place) < 0.5


def test_markers_that_photos_do_not_agree_on_have_no_place() -> None:
    cameras = [camera_at(np.array([150.0 * i - 300, 0.0, 700.0])) for i in range(5)]
    pixels = np.random.default_rng(10).uniform(0, 600, (5, 2))
    assert triangulate(cameras, pixels, 1.0, least=4) is None
    assert triangulate(cameras[:1], pixels[:1], 1.0) is None
    assert triangulate([cameras[0]] * 2, pixels[:1].repeat(2, axis=0), 1.0) is None  # one ray shows no depth


def cap(count: int = 6000) -> Cloud:
    """The front of a ball of radius 80 with a round hole of radius 12 in it, in a fairly even spread."""
    number = np.arange(2 * count) + 0.5
    polar, turn = np.arccos(1 - number / count), np.pi * (1 + 5**0.5) * number
    sphere = np.stack([np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)], axis=1)
    sphere = sphere[sphere[:, 2] > 0]
    sphere = sphere[np.linalg.norm(sphere - [0.6, 0.0, 0.8], axis=1) > 0.15]
    spacing = 80 * np.sqrt(2 * np.pi / count)
    return Cloud(points=80 * sphere, normals=sphere, colors=0.5 + 0.5 * sphere.clip(-1, 1), spacing=spacing)


def test_cleaning_takes_what_stands_apart_and_nothing_else() -> None:
    rng, good = np.random.default_rng(11), cap()
    scattered, blob = rng.uniform(-300, 300, (150, 3)), rng.normal((0, 0, -100), 3, (200, 3))
    points = np.r_[good.points, scattered, blob]
    dirty = Cloud(points=points, normals=points * 0 + 1, colors=points * 0, spacing=good.spacing)
    kept = clean(dirty, 2.5, 0.05).points
    distance = np.abs(np.linalg.norm(kept, axis=1) - 80)
    assert np.percentile(distance, 99.9) < 1e-6
    assert len(kept) > 0.97 * len(good.points)


def test_points_with_six_neighbours_hang_together() -> None:
    good, places = cap(), 0.5 * np.arange(7)[:, None] * [1.0, 0.0, 0.0] + [0.0, 0.0, 500.0]
    for count in (6, 7):
        points = np.r_[good.points, places[:count]]
        cloud = Cloud(points=points, normals=points * 0 + 1, colors=points * 0, spacing=good.spacing)
        assert (clean(cloud, 2.5, 0.0).points[:, 2] > 400.0).sum() == (7 if count == 7 else 0)


def test_points_on_a_plane_have_its_normal_on_the_side_of_the_cameras() -> None:
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(5.0), np.arange(5.0)))
    plane = np.stack([x, y, 0.5 * x], axis=1)
    normal = np.array([-0.5, 0.0, 1.0]) / np.sqrt(1.25)
    for side in (1.0, -1.0):
        towards = np.tile([0.0, 0.0, side], (25, 1))
        np.testing.assert_allclose(_normals(plane, towards), np.tile(side * normal, (25, 1)), atol=1e-12)


@pytest.mark.needs_scan
def test_surfaces_go_through_the_points_and_end_where_none_are() -> None:
    cloud = cap()
    scan, again = (make_surface(cloud, "cap", gap=3.0, smallest=0.05) for _ in range(2))
    assert scan.normals is not None
    assert scan.colors is not None
    error = np.abs(np.linalg.norm(scan.points, axis=1) - 80)
    covered = cKDTree(cloud.points).query(scan.points)[0] < cloud.spacing
    assert error[covered].max() < 0.3
    assert error.max() < cloud.spacing
    assert scan.points[:, 2].min() > -4 * cloud.spacing  # no bottom
    middle = np.linalg.norm(scan.points / 80 - [0.6, 0.0, 0.8], axis=1)
    assert middle.min() > 0.15 - 4 * cloud.spacing / 80  # the hole stays
    outward = np.einsum("nc,nc->n", scan.normals, scan.points) / 80
    assert np.median(outward) > 0.99
    assert np.percentile(np.abs(scan.colors - (0.5 + 0.5 * scan.points / 80)), 95) < 0.03
    assert np.array_equal(scan.points, again.points)
    assert np.array_equal(scan.triangles, again.triangles)
