"""Pinhole views: where pixels look, and the place that rays of several views meet at."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray

_REWEIGHTINGS = 12  # of reweighting


@dataclass(frozen=True, kw_only=True)
class Pinhole:
    """A square picture through a pinhole; the principal point is its middle."""

    axes: FloatArray  # (3, 3) rows: right, up, backward
    eye: FloatArray  # (3,)
    focal: float  # pixels
    size: int  # pixels a side

    @classmethod
    def around(cls, middle: FloatArray, axes: FloatArray, radius: float, size: int, distance: float = 5.0) -> Pinhole:
        """A view of the ball about `middle`, from `distance` radii away."""
        eye = middle + distance * radius * axes[2]
        return cls(axes=axes, eye=eye, focal=size / 2 * np.sqrt(distance**2 - 1.0), size=size)

    def directions(self, pixels: FloatArray) -> FloatArray:
        """(..., 3) where pixels (..., 2) look, with length 1 along the view; the top left corner is (0, 0)."""
        offset = (np.asarray(pixels, dtype=np.float64) - self.size / 2) / self.focal
        return np.asarray(offset[..., :1] * self.axes[0] - offset[..., 1:] * self.axes[1] - self.axes[2])

    def project(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n, 2) pixels of points (n, 3), and their depth (n,) along the view; the inverse of `directions`."""
        local = (np.asarray(points, dtype=np.float64) - self.eye) @ self.axes.T
        depth = -local[:, 2]
        pixels = self.size / 2 + self.focal * local[:, :2] * [1.0, -1.0] / depth[:, None]
        return np.asarray(pixels), np.asarray(depth)


def nearest_to_lines(eyes: FloatArray, directions: FloatArray) -> FloatArray:
    """(3,) the point nearest to lines from `eyes` (k, 3) along unit `directions` (k, 3), in least squares."""
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    return np.asarray(np.linalg.lstsq(across.sum(axis=0), np.einsum("kij,kj->i", across, eyes), rcond=None)[0])


def meeting_points(
    origins: FloatArray, directions: FloatArray, weights: FloatArray, scale: float
) -> tuple[FloatArray, FloatArray]:
    """The point nearest to all rays of each bundle, robustly, and the distance of each ray from it.

    Least squares of distances: ``sum_v w (1 - d d^T) x = sum_v w (1 - d d^T) o`` over rays with unit directions d from
    o, of which ``1 - d d^T`` drops what lies along them. Reweighted by ``1 / (1 + (distance / scale)^2)`` (Cauchy), so
    that rays far off don't count.

    :param origins: (v, 3) of each view
    :param directions: (v, k, 3) of each view's ray in each bundle, any length
    :param weights: (v, k), 0 or more
    :return: (k, 3) points and (v, k) distances
    """
    unit = directions / np.linalg.norm(directions, axis=2, keepdims=True)
    across = np.eye(3) - unit[..., :, None] * unit[..., None, :]  # (v, k, 3, 3) drops what lies along the ray
    offsets = np.einsum("vkij,vj->vki", across, origins)
    distances = np.zeros(weights.shape)
    points = np.zeros((weights.shape[1], 3))
    for _ in range(_REWEIGHTINGS):
        now = weights / (1.0 + (distances / scale) ** 2)
        system = np.einsum("vk,vkij->kij", now, across)
        slack = 1e-9 * np.trace(system, axis1=1, axis2=2) + np.finfo(np.float64).tiny
        system += slack[:, None, None] * np.eye(3)  # one ray alone: any point on it
        points = np.linalg.solve(system, np.einsum("vk,vki->ki", now, offsets)[..., None])[..., 0]
        distances = np.linalg.norm(np.einsum("vkij,kj->vki", across, points) - offsets, axis=2)
    return points, distances
