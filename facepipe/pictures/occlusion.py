"""Light that doesn't arrive: shadow maps, and ambient occlusion gathered from many of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.pictures.rasterise import rasterise, screen_triangles

AMBIENT_DIRECTIONS = 24
AMBIENT_RESOLUTION = 256
SHADOW_RESOLUTION = 768


@dataclass(frozen=True, kw_only=True)
class DepthMap:
    """What a distant light sees of the scene."""

    axes: FloatArray  # (3, 3) rows: right, up, towards the light
    scale: float  # map pixels per unit of length
    origin: FloatArray  # (3,) map coordinates of the world origin
    nearness: npt.NDArray[np.float32]  # (r, r) map units towards the light, 0 where nothing is

    def coordinates(self, points: FloatArray) -> FloatArray:
        """(n, 3) of world points: column, row, nearness, all in map pixels."""
        return np.asarray(points @ (self.axes.T * self.scale) + self.origin)

    def lit(self, points: FloatArray, normals: FloatArray, radius: int = 1) -> FloatArray:
        """(n,) share of light that reaches points with unit normals, softened over `radius` map pixels."""
        facing = np.abs(normals @ self.axes[2])
        # Leaving the surface along its normal, more at grazing light, keeps it from shading itself.
        lift = (0.6 + radius) * np.sqrt(np.maximum(1 - facing**2, 0)) + 0.3
        at = self.coordinates(points + normals * (lift / self.scale)[:, None]).astype(np.float32)
        return _compare(self.nearness, at, radius)


def depth_map(points: FloatArray, triangles: IntArray, towards: FloatArray, resolution: int) -> DepthMap:
    """The scene's triangles (t, 3) as seen from the direction `towards` (3,), a distant light."""
    backward = towards / np.linalg.norm(towards)
    helper = np.eye(3)[np.argmin(np.abs(backward))]
    right = np.cross(helper, backward)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(backward, right), backward])
    drawn = np.zeros(len(points), dtype=bool)
    drawn[triangles] = True
    low, high = (limit(axes @ points[drawn].T, axis=1) for limit in (np.min, np.max))
    scale = (resolution - 8) / max(float(np.max(high - low)), 1e-12)
    # Nearness starts at 1: 0 marks an empty pixel.
    origin = np.array([resolution / 2, resolution / 2, 1.0]) - scale * np.append((low + high)[:2] / 2, low[2])
    at = points @ (axes.T * scale) + origin
    screen = screen_triangles(np.column_stack([at, np.ones(len(at))]), triangles)
    nearness = rasterise(screen, resolution, resolution).nearness
    return DepthMap(axes=axes, scale=scale, origin=origin, nearness=nearness)


def ambient_occlusion(points: FloatArray, normals: FloatArray, triangles: IntArray) -> FloatArray:
    """(n,) share of the sky that each point sees, 0..1, weighted by the cosine with its normal."""
    seen, total = np.zeros(len(points)), np.zeros(len(points))
    if not len(triangles):
        return np.ones(len(points))
    for direction in sphere_directions(AMBIENT_DIRECTIONS):
        cosine = normals @ direction
        facing = np.flatnonzero(cosine > 0.02)
        light = depth_map(points, triangles, direction, AMBIENT_RESOLUTION)
        seen[facing] += cosine[facing] * light.lit(points[facing], normals[facing])
        total[facing] += cosine[facing]
    return np.where(total > 0, seen / np.maximum(total, 1e-12), 1.0)


def sphere_directions(count: int) -> FloatArray:
    """(count, 3) even directions, mirror-symmetric in X: half a Fibonacci sphere and its mirror image."""
    number = np.arange(count // 2) + 0.5
    y = 1 - 2 * number / (count // 2)
    turn = (number * (np.sqrt(5) - 1) / 2) % 1.0 * np.pi  # longitudes of the half with x >= 0
    ring = np.sqrt(1 - y**2)
    half = np.stack([ring * np.sin(turn), y, ring * np.cos(turn)], axis=1)
    return np.concatenate([half, half * (-1, 1, 1)])


def _compare(nearness: npt.NDArray[np.float32], at: npt.NDArray[np.float32], radius: int) -> FloatArray:
    """Percentage-closer filtering: the share of a bilinearly weighted window that is not nearer than the point."""
    size = nearness.shape[0]
    x, y = at[:, 0] - 0.5, at[:, 1] - 0.5
    column, row = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    fx, fy = x - column, y - row
    limit = at[:, 2]
    flat = nearness.ravel()
    lit = np.zeros(len(at), np.float32)
    for dy in range(-radius, radius + 2):
        weight_y = _window(dy, radius, fy)
        line = np.clip(row + dy, 0, size - 1) * size
        for dx in range(-radius, radius + 2):
            clear = flat[line + np.clip(column + dx, 0, size - 1)] <= limit
            lit += weight_y * _window(dx, radius, fx) * clear
    return lit / (2 * radius + 1) ** 2


def _window(step: int, radius: int, fraction: npt.NDArray[np.float32]) -> FloatArray:
    """Box of 2 radius + 1 pixels, moved by a fraction of a pixel: its ends fade in and out."""
    if step == -radius:
        return 1 - fraction
    if step == radius + 1:
        return fraction
    return np.ones_like(fraction)
