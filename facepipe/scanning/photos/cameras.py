"""The camera of a photo, as computer vision has it: x right, y down, z ahead; and cameras as a JSON file.

Files serve rigs that are calibrated, and bring the cameras of one scan to the next.
``{"unit": "mm", "cameras": {"front.jpg": {"width": 4000, "height": 6000, "focal": [8100, 8100],
"center": [2000, 3000], "distortion": [k1, k2, p1, p2], "rotation": [[...], [...], [...]],
"translation": [x, y, z]}, ...}}``: see `PhotoCamera`. `unit` (mm, cm, m) may be left out, as may `center` (the middle)
and `distortion` (none); `focal` may be one number.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.atomic import write_bytes
from facepipe.core.errors import InputError
from facepipe.core.reading import read_json_object
from facepipe.declare import from_json
from facepipe.geometry.pinhole import nearest_to_lines
from facepipe.scanning.photos.photos import Photo
from facepipe.scans import LANDMARK_COUNT, Scan, no_landmarks

_STEPS, _EXACT = 30, 1e-12  # of the lens undone
_LARGEST_FILE = 16_000_000  # bytes
_SIZES, _NUMBERS = {"low": 1, "high": 100_000}, {"low": -1e12, "high": 1e12}
_TURNED = 1e-3  # how far a rotation may be from one
Sightings = Mapping[str, Mapping[str, FloatArray]]  # photo -> what -> (2,) pixels of the upright photo, full size

_WIDE = np.cos(np.radians(3.0))  # rays closer together than this say little about depth
_LARGEST_STRUCTURE = 64_000_000  # bytes
_LARGEST = 1e9  # pixels
_TOLERANCE = 0.012  # of a photo's longer side
_LEAST = 3  # photos
_OUTLINE = 17  # the first landmarks lie on the face's outline, another place of the skin in every photo


@dataclass(frozen=True, kw_only=True)
class PhotoCamera:
    """A pinhole camera with lens distortion: where a point of the scan shows in a photo.

    ``local = rotation @ point + translation``; the ray (x, y) = local / depth is bent as in OpenCV's model of four
    coefficients (Brown 1966), then shows at ``focal * bent + center``. Pixels count from the top left corner of the
    photo, so that the middle of the first pixel is at (0.5, 0.5).
    """

    width: int  # pixels of the photo, upright
    height: int
    focal: tuple[float, float]  # pixels
    center: tuple[float, float]  # principal point, pixels
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)  # k1 k2 p1 p2
    rotation: FloatArray = field(default_factory=lambda: np.eye(3))  # (3, 3) scan -> camera
    translation: FloatArray = field(default_factory=lambda: np.zeros(3))  # (3,)

    @property
    def matrix(self) -> FloatArray:
        """(3, 3) of the intrinsics."""
        return np.array([[self.focal[0], 0.0, self.center[0]], [0.0, self.focal[1], self.center[1]], [0.0, 0.0, 1.0]])

    @property
    def eye(self) -> FloatArray:
        """(3,) where it stands."""
        return np.asarray(-self.rotation.T @ self.translation)

    @property
    def ahead(self) -> FloatArray:
        """(3,) unit vector of its axis."""
        return np.asarray(self.rotation[2])

    def scaled(self, width: int, height: int) -> PhotoCamera:
        """The same camera of a photo resized to other pixels."""
        x, y = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            focal=(self.focal[0] * x, self.focal[1] * y),
            center=(self.center[0] * x, self.center[1] * y),
        )

    def to_camera(self, points: FloatArray) -> FloatArray:
        """(n, 3) points in camera coordinates."""
        return np.asarray(np.asarray(points, dtype=np.float64) @ self.rotation.T + self.translation)

    def project(self, points: FloatArray) -> FloatArray:
        """(n, 2) pixels of points (n, 3); NaN behind the camera."""
        local = self.to_camera(points)
        depth = np.where(local[:, 2] > 0, local[:, 2], np.nan)
        return self.bend(local[:, :2] / depth[:, None]) * self.focal + self.center

    def bend(self, rays: FloatArray) -> FloatArray:
        """(n, 2) rays after the lens."""
        k1, k2, p1, p2 = self.distortion
        x, y = rays.T
        r2 = x * x + y * y
        radial = 1.0 + k1 * r2 + k2 * r2 * r2
        bent_x = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
        bent_y = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
        return np.stack([bent_x, bent_y], axis=1)

    def rays(self, pixels: FloatArray) -> FloatArray:
        """(n, 2) straight rays x / z, y / z of pixels (n, 2): `bend` undone by fixed-point steps."""
        bent = (np.asarray(pixels, dtype=np.float64) - self.center) / self.focal
        rays = bent.copy()
        for _ in range(_STEPS if any(self.distortion) else 0):
            change = bent - self.bend(rays)
            rays += change
            if not np.abs(change).max(initial=0.0) > _EXACT:
                break
        return rays


@dataclass(frozen=True, kw_only=True)
class Cameras:
    """Cameras by the names of their photos."""

    cameras: Mapping[str, PhotoCamera] = field(default_factory=dict)
    unit: str | None = None  # mm, cm or m; None: unknown


_Triple = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class _CameraEntry:
    width: int = field(metadata=_SIZES)
    height: int = field(metadata=_SIZES)
    focal: float | tuple[float, float] = field(metadata=_NUMBERS)
    center: tuple[float, float] | None = field(default=None, metadata=_NUMBERS)
    distortion: tuple[float, float, float, float] = field(default=(0.0, 0.0, 0.0, 0.0), metadata=_NUMBERS)
    rotation: tuple[_Triple, _Triple, _Triple]
    translation: _Triple = field(metadata=_NUMBERS)

    def camera(self, where: str) -> PhotoCamera:
        """:raises InputError: a focal length that is not above 0, or no rotation"""
        focal_x, focal_y = self.focal if isinstance(self.focal, tuple) else (self.focal, self.focal)
        if min(focal_x, focal_y) <= 0:
            raise InputError(f"{where} -> focal", f"{self.focal}, expected pixels above 0")
        x, y = self.center or (self.width / 2, self.height / 2)
        k1, k2, p1, p2 = self.distortion
        # The nearest rotation, U V^T of the singular value decomposition: files have rounded numbers.
        matrix = np.array(self.rotation, dtype=np.float64)
        U, _, Vt = np.linalg.svd(matrix)
        nearest = np.asarray(U @ Vt)
        if np.abs(matrix - nearest).max() > _TURNED or not math.isclose(np.linalg.det(nearest), 1.0, abs_tol=0.5):
            what = "is no rotation, expected rows of unit length at right angles, not mirrored"
            raise InputError(f"{where} -> rotation", what)
        return PhotoCamera(
            width=self.width,
            height=self.height,
            focal=(float(focal_x), float(focal_y)),
            center=(float(x), float(y)),
            distortion=(float(k1), float(k2), float(p1), float(p2)),
            rotation=nearest,
            translation=np.array(self.translation, dtype=np.float64),
        )


@dataclass(frozen=True, kw_only=True)
class _CamerasFile:
    cameras: Mapping[str, _CameraEntry]
    unit: Literal["mm", "cm", "m"] | None = None


def read_cameras(path: Path) -> Cameras:
    """The cameras in a file.

    :raises InputError: not readable, or values that are no camera
    """
    content = read_json_object(path, _LARGEST_FILE)
    known = {key: content[key] for key in ("cameras", "unit") if key in content}
    file = from_json(_CamerasFile, known, str(path))
    if not file.cameras:
        raise InputError(f"{path} -> cameras", "none, expected some by the names of their photos")
    cameras = {name: entry.camera(f"{path} -> cameras -> {name[:80]}") for name, entry in file.cameras.items()}
    return Cameras(cameras=cameras, unit=file.unit)


def write_cameras(path: Path, cameras: Cameras) -> None:
    """Write what `read_cameras` reads.

    :raises InputError: the folder does not exist or can't be written
    """
    content: dict[str, object] = {"cameras": {name: vars(camera) for name, camera in cameras.cameras.items()}}
    content |= {"unit": cameras.unit} if cameras.unit else {}
    text = json.dumps(content, indent=1, sort_keys=True, default=np.ndarray.tolist)
    write_bytes(path, f"{text}\n".encode())


def read_markers(path: Path) -> dict[str, dict[str, FloatArray]]:
    """``{"photos": {"front.jpg": {"chin": [x, y], ...}, ...}}``: pixels of the upright photo, from its top left corner.

    :raises InputError: not readable, or another content
    """
    photos = read_json_object(path, _LARGEST_STRUCTURE).get("photos")
    if not isinstance(photos, dict):
        raise InputError(f"{path} -> photos", "expected an object of markers by the names of photos")
    sightings: dict[str, dict[str, FloatArray]] = {}
    for photo, markers in photos.items():
        if not isinstance(markers, dict):
            raise InputError(f"{path} -> {photo[:80]}", "expected an object of places by the names of markers")
        for name, value in markers.items():
            pixel: list[Any] = value if isinstance(value, list) else []
            # NaN fails the comparison
            if len(pixel) != 2 or not all(type(one) in (int, float) and abs(one) <= _LARGEST for one in pixel):
                where = f"{path} -> {photo[:80]} -> {name[:80]}"
                raise InputError(where, f"{str(value)[:40]}, expected [x, y] in pixels")
        sightings[photo] = {name: np.array(value, dtype=np.float64) for name, value in markers.items()}
    return sightings


def triangulate_all(
    sightings: Sightings, cameras: Mapping[str, PhotoCamera], tolerance: float, least: int
) -> dict[str, FloatArray]:
    """Name -> (3,) place of what `least` photos or more agree on, by name.

    :param sightings: in pixels of the cameras' photos
    :param tolerance: pixels
    """
    names = sorted({name for sighting in sightings.values() for name in sighting})
    places = {}
    for name in names:
        photos = [camera for camera in sorted(cameras) if name in sightings.get(camera, {})]
        pixels = np.array([sightings[photo][name] for photo in photos])
        place = triangulate([cameras[photo] for photo in photos], pixels, tolerance, least)
        if place is not None:
            places[name] = place
    return places


def triangulate(
    cameras: Sequence[PhotoCamera], pixels: FloatArray, tolerance: float, least: int = 2
) -> FloatArray | None:
    """(3,) the place that shows within `tolerance` pixels of most `pixels` (k, 2); None: fewer than `least` agree.

    Every two photos propose a place (all of them, so that nothing is left to chance); that of most agreement, and
    then of the smallest error, wins and is fitted to the photos that agree.
    """
    if len(cameras) < max(least, 2):
        return None
    eyes = np.array([camera.eye for camera in cameras])
    rays = np.empty((len(cameras), 3))  # unit vectors in scan coordinates
    for number, (camera, pixel) in enumerate(zip(cameras, pixels, strict=True)):
        ray = np.append(camera.rays(pixel[None])[0], 1.0) @ camera.rotation
        rays[number] = ray / np.linalg.norm(ray)
    best: tuple[int, float] = (0, 0.0)
    chosen = None
    for pair in itertools.combinations(range(len(cameras)), 2):
        # a place's error along its rays is that across them over the sine of their angle: 19 times at 3 degrees
        if rays[pair[0]] @ rays[pair[1]] > _WIDE:
            continue
        place = nearest_to_lines(eyes[list(pair)], rays[list(pair)])
        # (k,) pixels between where a place shows and where it was seen; infinite behind a camera
        shown = np.concatenate([camera.project(place[None]) for camera in cameras])
        error = np.asarray(np.nan_to_num(np.linalg.norm(shown - pixels, axis=1), nan=np.inf))
        agree = error <= tolerance
        rank = (int(agree.sum()), -float(error[agree].sum()))
        if rank > best:
            best, chosen = rank, agree
    if chosen is None or best[0] < least:
        return None
    return nearest_to_lines(eyes[chosen], rays[chosen])


def landmark_sightings(photos: Sequence[Photo], step: Callable[[], None]) -> dict[str, dict[str, FloatArray]]:
    """Photo -> landmark number -> (2,) pixels, of photos that show a face; none where torch is not there.

    :param step: called before every photo
    """
    try:
        from facepipe.networks import find_landmarks
    except ImportError:
        return {}
    sightings = {}
    for photo in photos:
        step()
        faces = find_landmarks(photo.pixels.astype(np.float32) / 255.0)
        if faces:
            places = faces[0].landmarks
            sightings[photo.name] = {f"{number:02d}": places[number] for number in range(_OUTLINE, LANDMARK_COUNT)}
    return sightings


def place_landmarks(
    sightings: Mapping[str, Mapping[str, FloatArray]], cameras: Mapping[str, PhotoCamera], scan: Scan
) -> FloatArray:
    """(68, 3) landmarks on the scan, NaN where photos don't agree; the outline of the face (0-16) is left out."""
    from scipy.spatial import cKDTree

    points = no_landmarks()
    if not sightings:
        return points
    size = float(np.median([max(camera.width, camera.height) for camera in cameras.values()]))
    for name, place in triangulate_all(sightings, cameras, _TOLERANCE * size, _LEAST).items():
        points[int(name)] = place
    known = np.isfinite(points).all(axis=1)
    if known.any():
        widths = [float(np.median(one.to_camera(points[known])[:, 2])) / one.focal[0] for one in cameras.values()]
        reach = _TOLERANCE * size * float(np.median(widths))
        # by the same tolerance as the photos' agreement: farther off, the nearest point is another place of the face
        distance, near = cKDTree(scan.points).query(points[known])
        points[known] = np.where((distance <= reach)[:, None], scan.points[near], points[known])
    return points
