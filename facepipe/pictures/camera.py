"""Cameras: where a portrait is taken from, and how it falls onto pixels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from facepipe.core.arrays import FloatArray

View = Literal["front", "side", "three-quarter"] | tuple[float, float]

# Yaw turns the camera towards the subject's left, pitch raises it; radians.
VIEWS: dict[str, tuple[float, float]] = {
    "front": (0.0, 0.0),
    "side": (np.pi / 2, 0.0),
    "three-quarter": (np.radians(38.0), np.radians(4.0)),
}
LENS = 12.0 / 105.0  # tangent of half the vertical view angle: a 105 mm lens on a 36 x 24 mm frame
MARGIN = 0.06  # of the frame, kept free on every side


@dataclass(frozen=True, kw_only=True)
class Camera:
    """A pinhole camera in a Y-up world."""

    axes: FloatArray  # (3, 3) rows: right, up, backward
    eye: FloatArray  # (3,) world
    focal: float  # pixels
    center: tuple[float, float]  # principal point, pixels, y down

    def to_camera(self, points: FloatArray) -> FloatArray:
        """(n, 3) world points as camera coordinates: x right, y up, z towards the viewer."""
        return np.asarray((points - self.eye) @ self.axes.T)

    def project(self, points: FloatArray) -> FloatArray:
        """(n, 4) homogeneous screen points ``x w, y w, 1, w`` of world points; w is the depth along the view."""
        local = self.to_camera(points)
        w = -local[:, 2]
        x = self.focal * local[:, 0] + self.center[0] * w
        y = -self.focal * local[:, 1] + self.center[1] * w
        return np.stack([x, y, np.ones(len(points)), w], axis=1)

    def scaled(self, factor: float) -> Camera:
        """The same camera with `factor` times the pixels in each direction."""
        return replace(self, focal=self.focal * factor, center=(self.center[0] * factor, self.center[1] * factor))


def y_up(points: FloatArray, up_axis: str) -> FloatArray:
    """Points of a stage turned so that Y is up and faces look along +Z (in Z-up stages they look along -Y)."""
    if up_axis == "Y":
        return np.asarray(points, dtype=np.float64)
    return np.stack([points[:, 0], points[:, 2], -points[:, 1]], axis=1).astype(np.float64)


def portrait(points: FloatArray, view: View, width: int, height: int, right: int = 0) -> Camera:
    """A long-lens camera with all `points` (n, 3), Y up, in a picture but for `right` pixels of its width."""
    yaw, pitch = VIEWS[view] if isinstance(view, str) else view
    backward = np.array([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)])
    across = np.array([np.cos(yaw), 0.0, -np.sin(yaw)])
    axes = np.stack([across, np.cross(backward, across), backward])
    inner_width, inner_height = max(width - right, 1) * (1 - 2 * MARGIN), height * (1 - 2 * MARGIN)
    middle = (width - right) / 2, height / 2
    local = points @ axes.T if len(points) else np.zeros((1, 3))
    center = (local.min(axis=0) + local.max(axis=0)) / 2
    x, y, z = np.abs(local - center).T[0], np.abs(local - center).T[1], (local - center)[:, 2]
    focal = inner_height / 2 / LENS
    distance = float(np.max(z + focal * np.maximum(x / (inner_width / 2), y / (inner_height / 2))))
    distance = max(distance, float(np.ptp(z)), 1e-3)
    return Camera(axes=axes, eye=(center + np.array([0.0, 0.0, distance])) @ axes, focal=focal, center=middle)
