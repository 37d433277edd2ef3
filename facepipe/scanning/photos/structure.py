"""Where the cameras stood, and points that several photos show: features, matches and bundle adjustment by COLMAP.

Document S12: pixels of one place on the face are matched between photos, and the matches calibrate the cameras.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray
from facepipe.core.errors import FitError, InputError
from facepipe.scanning.photos.cameras import PhotoCamera
from facepipe.scanning.photos.options import FEWEST_PHOTOS, ScanPhotosOptions
from facepipe.scanning.photos.photos import Photo

_FEATURES = 6000  # of a photo, at most
_GUESS = 2.0  # focal length over the longer side where EXIF has none: portrait lenses are long
_ADVICE = "neighbouring photos must show much the same of the face, about 15 degrees apart"


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
        lenses = _lenses(photos, files, known)
        _match(colmap, folder, lenses, options)
        if known is None:
            model = _mapped(colmap, folder, options)
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


def _lenses(
    photos: Sequence[Photo], files: Mapping[str, str], known: Mapping[str, PhotoCamera] | None
) -> dict[str, dict[str, Any]]:
    """COLMAP's camera model and parameters of every file whose lens is known."""
    if known is not None:
        return {
            files[name]: {"model": "OPENCV", "params": [*one.focal, *one.center, *one.distortion]}
            for name, one in known.items()
        }
    return {
        files[photo.name]: {"model": "SIMPLE_RADIAL", "params": [photo.focal, photo.width / 2, photo.height / 2, 0.0]}
        for photo in photos
        if photo.focal is not None
    }


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
        _set_lenses(colmap, database, lenses)
        colmap.match_exhaustive(database, matching_options=matching, verification_options=checking)


def _set_lenses(colmap: Any, database: Path, lenses: Mapping[str, dict[str, Any]]) -> None:
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


def _pipeline(colmap: Any, options: ScanPhotosOptions) -> Any:
    settings = colmap.IncrementalPipelineOptions()
    settings.num_threads, settings.random_seed = 1, options.seed
    settings.extract_colors = settings.multiple_models = False
    settings.min_model_size = 3
    return settings


def _mapped(colmap: Any, folder: Path, options: ScanPhotosOptions) -> Any:
    with _failing():
        models = colmap.incremental_mapping(
            folder / "matches.db", folder / "photos", folder, _pipeline(colmap, options)
        )
    if not models:
        raise FitError("photos", f"no two of them match well enough to start from: {_ADVICE}")
    return max(models.values(), key=lambda one: (one.num_reg_images(), one.num_points3D()))


def _triangulated(colmap: Any, folder: Path, known: Mapping[str, PhotoCamera], options: ScanPhotosOptions) -> Any:
    model = colmap.Reconstruction()
    database = colmap.Database.open(folder / "matches.db")
    try:
        images = database.read_all_images()
    finally:
        database.close()
    with _failing():
        for image in images:
            if image.name in known:
                _place(colmap, model, image, known[image.name])
        return colmap.triangulate_points(
            model, folder / "matches.db", folder / "photos", folder, options=_pipeline(colmap, options)
        )


def _place(colmap: Any, model: Any, image: Any, camera: PhotoCamera) -> None:
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


def _structure(model: Any, names: Mapping[str, str], count: int) -> Structure:
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
    return Structure(
        cameras={names[image.name]: _camera(image, model.cameras[image.camera_id]) for image in images},
        points=points,
        seen=seen,
        error=float(model.compute_mean_reprojection_error()),
    )


def _camera(image: Any, lens: Any) -> PhotoCamera:
    pose = np.asarray(image.cam_from_world().matrix())
    bent = lens.params[lens.extra_params_idxs()]
    return PhotoCamera(
        width=int(lens.width),
        height=int(lens.height),
        focal=(float(lens.focal_length_x), float(lens.focal_length_y)),
        center=(float(lens.principal_point_x), float(lens.principal_point_y)),
        distortion=(*map(float, bent), *([0.0] * (4 - len(bent)))),  # type: ignore[arg-type]
        rotation=pose[:, :3],
        translation=pose[:, 3],
    )
