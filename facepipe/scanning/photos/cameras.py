"""The camera of a photo, as computer vision has it: x right, y down, z ahead; and cameras as a JSON file.

Files serve rigs that are calibrated, and bring the cameras of one scan to the next.
``{"unit": "mm", "cameras": {"front.jpg": {"width": 4000, "height": 6000, "focal": [8100, 8100],
"center": [2000, 3000], "distortion": [k1, k2, p1, p2], "rotation": [[...], [...], [...]],
"translation": [x, y, z]}, ...}}``: see `PhotoCamera`. `unit` (mm, cm, m) may be left out, as may `center` (the middle)
and `distortion` (none); `focal` may be one number.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.atomic import write_bytes
from facepipe.core.errors import InputError
from facepipe.core.reading import read_json_object
from facepipe.declare import from_json

_STEPS, _EXACT = 30, 1e-12  # of the lens undone
_LARGEST_FILE = 16_000_000  # bytes
_SIZES, _NUMBERS = {"low": 1, "high": 100_000}, {"low": -1e12, "high": 1e12}
_TURNED = 1e-3  # how far a rotation may be from one


def no_rotation() -> FloatArray:
    """A (3, 3) identity matrix."""
    return np.eye(3)


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
    rotation: FloatArray = field(default_factory=no_rotation)  # (3, 3) scan -> camera
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
        return PhotoCamera(
            width=self.width,
            height=self.height,
            focal=(float(focal_x), float(focal_y)),
            center=(float(x), float(y)),
            distortion=(float(k1), float(k2), float(p1), float(p2)),
            rotation=_rotation(self.rotation, f"{where} -> rotation"),
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


def _rotation(rows: tuple[_Triple, ...], where: str) -> FloatArray:
    matrix = np.array(rows, dtype=np.float64)
    U, _, Vt = np.linalg.svd(matrix)
    nearest = U @ Vt
    if np.abs(matrix - nearest).max() > _TURNED or not math.isclose(np.linalg.det(nearest), 1.0, abs_tol=0.5):
        raise InputError(where, "is no rotation, expected rows of unit length at right angles, not mirrored")
    return np.asarray(nearest)
