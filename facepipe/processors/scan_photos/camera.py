"""The camera of a photo, as computer vision has it: x right, y down, z ahead."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from facepipe.core.arrays import FloatArray

_STEPS, _EXACT = 30, 1e-12  # of the lens undone


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
