"""Where the cameras stood, points that several photos show, by COLMAP, and what of it is the subject, upright.

Document S12: pixels of one place on the face are matched between photos, and the matches calibrate the cameras.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray
from facepipe.core.errors import FitError, InputError
from facepipe.geometry.pinhole import nearest_to_lines
from facepipe.geometry.similarity import Similarity
from facepipe.scanning.photos.cameras import PhotoCamera
from facepipe.scanning.photos.options import FEWEST_PHOTOS, ScanPhotosOptions
from facepipe.scanning.photos.photos import Photo

_FEATURES = 6000  # of a photo, at most
_GUESS = 2.0  # focal length over the longer side where EXIF has none: portrait lenses are long
_ADVICE = "neighbouring photos must show much the same of the face, about 15 degrees apart"
_ANGLES = np.radians((3.0, 35.0))  # between two photos whose depth is found together
_BEST_ANGLE = np.radians(13.0)
_FEWEST_SHARED = 16  # matched points
_ACROSS = 0.5  # least share of the line between two cameras that is across the view
_CROP = 1.25  # of the ball around the middle half of the points, and more, what counts as the person


@dataclass(frozen=True, kw_only=True)
class Structure:
    """Cameras by the names of their photos, as used, and matched points."""

    cameras: Mapping[str, PhotoCamera]  # of the photos that could be placed, by name
    points: FloatArray  # (p, 3)
    seen: BoolArray  # (cameras, p) which camera shows which point, cameras in order
    error: float  # pixels, mean distance of the points' places in the photos from where they were found


def find_structure(
    photos: Sequence[Photo], options: ScanPhotosOptions, known: Mapping[str, PhotoCamera] | None = None
) -> Structure:
    """Cameras and matched points of photos; `known` cameras (of the photos as used) are taken as they are.

    :raises InputError: pycolmap is not there
    :raises FitError: fewer than 5 photos could be placed
    """
    colmap = colmap_module()
    with tempfile.TemporaryDirectory(prefix="facepipe-scan-") as name:
        folder = Path(name)
        files = _write_photos(photos, "each" if known else options.lens, folder)
        if known is None:  # COLMAP's camera model and parameters of every file whose lens is known
            lenses: dict[str, dict[str, Any]] = {
                files[one.name]: {"model": "SIMPLE_RADIAL", "params": [one.focal, one.width / 2, one.height / 2, 0.0]}
                for one in photos
                if one.focal is not None
            }
        else:
            lenses = {
                files[name]: {"model": "OPENCV", "params": [*one.focal, *one.center, *one.distortion]}
                for name, one in known.items()
            }
        _match(colmap, folder, lenses, options)
        if known is None:
            with _failing():
                models = colmap.incremental_mapping(
                    folder / "matches.db", folder / "photos", folder, _pipeline(colmap, options)
                )
            if not models:
                raise FitError("photos", f"no two of them match well enough to start from: {_ADVICE}")
            model = max(models.values(), key=lambda one: (one.num_reg_images(), one.num_points3D()))
        else:
            model = _triangulated(colmap, folder, {files[name]: known[name] for name in known}, options)
        return _structure(model, {file: name for name, file in files.items()}, len(photos))


def colmap_module() -> Any:
    """:raises InputError: pycolmap is not there"""
    try:
        import pycolmap
    except ImportError as error:
        raise InputError("pycolmap", "is not installed, expected `pip install 'facepipe[scan]'`") from error
    pycolmap.logging.minloglevel = 3  # its errors come back as exceptions and empty results
    return pycolmap


@contextlib.contextmanager
def _failing() -> Iterator[None]:
    """What COLMAP raises, as an error of ours."""
    try:
        yield
    except (RuntimeError, ValueError, IndexError) as error:
        raise FitError("photos", f"COLMAP gave up ({str(error)[:200]}): {_ADVICE}") from error


def _write_photos(photos: Sequence[Photo], lens: str, folder: Path) -> dict[str, str]:
    """Grey pictures in a folder for every lens, with their masks; name -> file below ``photos``."""
    from PIL import Image

    lenses: dict[object, int] = {}
    files = {}
    for number, photo in enumerate(photos):
        key = (photo.width, photo.height, photo.focal) if lens == "shared" else number
        group = lenses.setdefault(key, len(lenses))
        file = f"{group:04d}/{number:04d}.png"
        for top, pixels in (("photos", photo.pixels), ("masks", photo.mask)):
            if pixels is None:
                continue
            image = Image.fromarray(pixels).convert("L")
            path = folder / top / (file if top == "photos" else f"{file}.png")
            path.parent.mkdir(parents=True, exist_ok=True)
            image.save(path, compress_level=1)
        files[photo.name] = file
    return files


def _match(colmap: Any, folder: Path, lenses: Mapping[str, dict[str, Any]], options: ScanPhotosOptions) -> None:
    """Features of all photos, and verified matches of all pairs, in ``folder/matches.db``."""
    colmap.set_random_seed(options.seed)
    extraction, matching = colmap.FeatureExtractionOptions(), colmap.FeatureMatchingOptions()
    extraction.sift.max_num_features = _FEATURES
    extraction.num_threads = matching.num_threads = 1  # the same features in the same order
    reading, checking = colmap.ImageReaderOptions(), colmap.TwoViewGeometryOptions()
    reading.default_focal_length_factor = _GUESS
    if (folder / "masks").is_dir():
        reading.mask_path = folder / "masks"
    checking.ransac.random_seed = options.seed
    database = folder / "matches.db"
    with _failing():
        colmap.extract_features(
            database,
            folder / "photos",
            camera_mode=colmap.CameraMode.PER_FOLDER,
            reader_options=reading,
            extraction_options=extraction,
        )
        opened = colmap.Database.open(database)
        try:
            for image in opened.read_all_images():
                if image.name in lenses:
                    size = opened.read_camera(image.camera_id)
                    lens = colmap.Camera(
                        camera_id=image.camera_id, width=size.width, height=size.height, **lenses[image.name]
                    )
                    lens.has_prior_focal_length = True
                    opened.update_camera(lens)
        finally:
            opened.close()
        colmap.match_exhaustive(database, matching_options=matching, verification_options=checking)


def _pipeline(colmap: Any, options: ScanPhotosOptions) -> Any:
    settings = colmap.IncrementalPipelineOptions()
    settings.num_threads, settings.random_seed = 1, options.seed
    settings.extract_colors = settings.multiple_models = False
    settings.min_model_size = 3
    return settings


def _triangulated(colmap: Any, folder: Path, known: Mapping[str, PhotoCamera], options: ScanPhotosOptions) -> Any:
    model = colmap.Reconstruction()
    database = colmap.Database.open(folder / "matches.db")
    try:
        images = database.read_all_images()
    finally:
        database.close()
    with _failing():
        for image in images:
            if image.name not in known:
                continue
            camera = known[image.name]
            lens = colmap.Camera(
                camera_id=image.camera_id,
                model="OPENCV",
                width=camera.width,
                height=camera.height,
                params=[*camera.focal, *camera.center, *camera.distortion],
            )
            model.add_camera_with_trivial_rig(lens)
            placed = colmap.Image(name=image.name, camera_id=image.camera_id, image_id=image.image_id)
            pose = colmap.Rigid3d(np.column_stack([camera.rotation, camera.translation]))
            model.add_image_with_trivial_frame(placed, pose)
        return colmap.triangulate_points(
            model, folder / "matches.db", folder / "photos", folder, options=_pipeline(colmap, options)
        )


def _structure(model: Any, names: Mapping[str, str], count: int) -> Structure:
    # Sorted, so that the same photos give the same structure.
    images = sorted((one for one in model.images.values() if one.has_pose), key=lambda one: str(one.name))
    if len(images) < FEWEST_PHOTOS:
        raise FitError(
            "photos", f"{len(images)} of {count} could be placed, expected {FEWEST_PHOTOS} or more: {_ADVICE}"
        )
    row = {image.image_id: number for number, image in enumerate(images)}
    order = sorted(model.points3D)
    points = np.array([model.points3D[key].xyz for key in order]).reshape(-1, 3)
    seen = np.zeros((len(images), len(order)), bool)
    for column, key in enumerate(order):
        for element in model.points3D[key].track.elements:
            seen[row[element.image_id], column] = True
    cameras = {}
    for image in images:
        pose, lens = np.asarray(image.cam_from_world().matrix()), model.cameras[image.camera_id]
        bent = lens.params[lens.extra_params_idxs()]
        cameras[names[image.name]] = PhotoCamera(
            width=int(lens.width),
            height=int(lens.height),
            focal=(float(lens.focal_length_x), float(lens.focal_length_y)),
            center=(float(lens.principal_point_x), float(lens.principal_point_y)),
            distortion=(*map(float, bent), *([0.0] * (4 - len(bent)))),  # type: ignore[arg-type]
            rotation=pose[:, :3],
            translation=pose[:, 3],
        )
    return Structure(
        cameras=cameras,
        points=points,
        seen=seen,
        error=float(model.compute_mean_reprojection_error()),
    )


@dataclass(frozen=True, kw_only=True)
class Subject:
    """The ball that the person is in."""

    center: FloatArray  # (3,)
    radius: float

    def holds(self, points: FloatArray) -> BoolArray:
        """(n,) which points are in it."""
        return np.asarray(np.linalg.norm(points - self.center, axis=1) <= self.radius)


def find_subject(structure: Structure) -> tuple[Subject, Structure]:
    """The ball around the place that the cameras look at, as large as the photos show there; and what is in it.

    :raises FitError: no matched point is in it
    """
    cameras = list(structure.cameras.values())
    # the point nearest to the axes of all cameras
    center = nearest_to_lines(np.array([one.eye for one in cameras]), np.array([one.ahead for one in cameras]))
    reach = [
        0.5 * max(camera.width, camera.height) / camera.focal[0] * float(np.linalg.norm(camera.eye - center))
        for camera in cameras
    ]
    subject = Subject(center=center, radius=_CROP * float(np.median(reach)))
    inside = subject.holds(structure.points)
    if np.count_nonzero(inside) < _FEWEST_SHARED:
        found = f"{np.count_nonzero(inside)} of {len(inside)} matched points lie where the cameras look"
        raise FitError("photos", f"{found}, expected {_FEWEST_SHARED} or more: photos taken around one person")
    return subject, replace(structure, points=structure.points[inside], seen=structure.seen[:, inside])


def choose_pairs(structure: Structure, subject: Subject, neighbours: int) -> list[tuple[int, int]]:
    """Pairs of cameras, lower number first: those of each camera's best neighbours.

    Best is a turn of some 13 degrees, and many matched points in common.

    :raises FitError: no two cameras go together
    """
    cameras = list(structure.cameras.values())
    shared = structure.seen.astype(np.int64) @ structure.seen.T.astype(np.int64)
    score = np.zeros(shared.shape)
    for i, a in enumerate(cameras):
        for j, b in enumerate(cameras):
            if i == j or shared[i, j] < _FEWEST_SHARED:
                continue
            to_a, to_b, line = a.eye - subject.center, b.eye - subject.center, b.eye - a.eye
            cosine = float(to_a @ to_b / np.linalg.norm(to_a) / np.linalg.norm(to_b))
            angle = float(np.arccos(np.clip(cosine, -1.0, 1.0)))
            if not _ANGLES[0] <= angle <= _ANGLES[1]:
                continue
            view = a.ahead + b.ahead
            along = abs(float(line @ view)) / float(np.linalg.norm(line)) / float(np.linalg.norm(view))
            if np.sqrt(max(0.0, 1.0 - along**2)) >= _ACROSS:
                # The root: errors of means fall with the root of the number of points.
                fitness = float(np.exp(-(np.log(angle / _BEST_ANGLE) ** 2)))
                score[i, j] = fitness * np.sqrt(shared[i, j])
    pairs = set()
    for i, row in enumerate(score):
        best = np.argsort(-row, kind="stable")[:neighbours]
        pairs |= {(min(i, int(j)), max(i, int(j))) for j in best if row[j] > 0}
    if not pairs:
        low, high = np.degrees(_ANGLES)
        raise FitError(
            "photos", f"no two are {low:g} to {high:g} degrees apart and show the same: photos closer together"
        )
    return sorted(pairs)


def upright(structure: Structure, subject: Subject, radius: float) -> tuple[Structure, Subject]:
    """The same with Y up and Z towards the cameras, as most photos have it, and the subject's ball at the origin.

    :param radius: of the ball
    """
    cameras = list(structure.cameras.values())
    down = np.mean([camera.rotation[1] for camera in cameras], axis=0)
    backward = -np.mean([camera.ahead for camera in cameras], axis=0)
    if np.linalg.norm(down) < 1e-6 or np.linalg.norm(np.cross(down, backward)) < 1e-6:
        down, backward = cameras[0].rotation[1], -cameras[0].ahead
    up = -down / np.linalg.norm(down)
    z = backward - (backward @ up) * up
    z /= np.linalg.norm(z)
    rotation = np.stack([np.cross(up, z), up, z])
    scale = radius / subject.radius
    moved = Similarity(rotation=rotation, translation=-scale * rotation @ subject.center, scale=scale)
    turned = {name: move_camera(one, moved) for name, one in structure.cameras.items()}
    structure = replace(structure, cameras=turned, points=moved.apply(structure.points))
    return structure, Subject(center=np.zeros(3), radius=radius)


def move_camera(camera: PhotoCamera, by: Similarity) -> PhotoCamera:
    """The camera that sees moved points as it saw them."""
    rotation = camera.rotation @ by.rotation.T
    return replace(camera, rotation=rotation, translation=by.scale * camera.translation - rotation @ by.translation)


def scale_of_markers(markers: Mapping[str, FloatArray], between: tuple[str, str, float]) -> float:
    """The factor that makes two markers the given distance apart.

    :raises InputError: one of them has no place, or they are at one place
    """
    first, second, distance = between
    for name in (first, second):
        if name not in markers:
            raise InputError(f"marker {name}", "two photos or more must show it at one place")
    apart = float(np.linalg.norm(markers[first] - markers[second]))
    if not apart > 0:
        raise InputError(f"markers {first} and {second}", "are at one place, expected some distance")
    return distance / apart
