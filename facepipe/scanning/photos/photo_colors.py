"""Colours of a scan's surface from its photos themselves: sharper than the means at its points."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from facepipe.core.arrays import ByteArray, Float32Array, FloatArray, IntArray
from facepipe.geometry.colors import from_srgb
from facepipe.geometry.rasterise import rasterise, screen_triangles
from facepipe.scanning.photos.cameras import PhotoCamera
from facepipe.scanning.photos.photos import fitting, read_photos

_LARGEST = 1600  # pixels a side of the depth that decides what a photo sees
_BEHIND = 8.0  # widths of such a pixel: a place so far behind the surface still is on it
_EDGE = 5  # such pixels across, around what hides something
_FRAME = 4.0  # pixels off the photo's border
_TURNED = 0.2  # cosine to the viewer that a place needs
_AHEAD = 8  # power of the cosine: photos from ahead count most
_FINER = 1.5  # than the places: how much photos stay; less would blur, more would be noise
_CHUNK = 1 << 14  # places at a time: OpenCV takes no more than 32766


@dataclass(frozen=True, kw_only=True)
class PhotoColors:
    """Photos around a scan."""

    folder: Path
    cameras: Mapping[str, PhotoCamera]  # by the photos' names
    points: FloatArray  # (n, 3) of the scan
    triangles: IntArray  # (t, 3)

    def __call__(self, points: FloatArray, normals: FloatArray, spacing: float) -> Float32Array:
        """(m, 3) linear colours at places (m, 3) of the scan's surface; NaN where no photo sees them.

        :param normals: (m, 3) unit, outward
        :param spacing: distance of the places; much finer photos are shrunk
        :raises InputError: a photo that can't be read
        """
        levels = from_srgb(np.arange(256) / 255).astype(np.float32)
        total, weights = np.zeros((len(points), 3), np.float32), np.zeros(len(points), np.float32)
        for name, camera in self.cameras.items():
            depth = self._depth(camera.scaled(*fitting((camera.width, camera.height), _LARGEST)))
            pixels = self._pixels(name, camera, spacing)
            for start in range(0, len(points), _CHUNK):
                at = slice(start, start + _CHUNK)
                seen, weight, places = _seen(camera, depth, points[at], normals[at])
                total[start + seen] += weight[:, None] * levels[_shown(pixels, places)]
                weights[start + seen] += weight
        with np.errstate(invalid="ignore"):
            return np.asarray(total / weights[:, None])

    def _pixels(self, name: str, camera: PhotoCamera, spacing: float) -> ByteArray:
        """(h, w, 3) sRGB of a photo, whose pixels are not much finer on the scan than `spacing`."""
        longer = max(camera.width, camera.height)
        width = float(np.median(camera.to_camera(self.points)[:, 2])) / camera.focal[0]
        most = int(np.ceil(longer * min(1.0, _FINER * width / spacing)))
        return read_photos([self.folder / name], most)[0].pixels

    def _depth(self, camera: PhotoCamera) -> FloatArray:
        """(h, w) of the nearest surface, drawn out at edges; infinite where there is none."""
        from scipy.ndimage import minimum_filter

        depth = camera.to_camera(self.points)[:, 2]
        places = np.nan_to_num(camera.project(self.points)) * depth[:, None]
        screen = np.column_stack([places, np.ones(len(depth)), depth])
        nearness = rasterise(screen_triangles(screen, self.triangles), camera.width, camera.height).nearness
        with np.errstate(divide="ignore"):
            return np.asarray(minimum_filter(1 / nearness, _EDGE))


def _seen(
    camera: PhotoCamera, depth: FloatArray, points: FloatArray, normals: FloatArray
) -> tuple[IntArray, Float32Array, FloatArray]:
    """Which of the places (m, 3) a photo sees (s,), how much it counts there (s,), and where it shows them (s, 2).

    :param depth: (h, w) of the nearest surface
    """
    towards = camera.eye - points
    ahead = np.einsum("mc,mc->m", normals, towards) / np.linalg.norm(towards, axis=1)
    turned = np.flatnonzero(ahead > _TURNED)
    size = np.array([camera.width, camera.height])
    pixels, own = camera.project(points[turned]), camera.to_camera(points[turned])[:, 2]
    border = np.minimum(pixels, size - pixels).min(axis=1) / _FRAME
    column, row = (np.where(border[:, None] > 0, pixels / size, 0) * depth.shape[::-1]).astype(np.int64).T
    behind = _BEHIND * own / camera.focal[0] * camera.width / depth.shape[1]
    kept = np.flatnonzero((border > 0) & (own <= depth[row, column] + behind))
    seen = turned[kept]
    weight = ahead[seen] ** _AHEAD * np.minimum(border[kept], 1)
    return seen, weight.astype(np.float32), pixels[kept] / size


def _shown(pixels: ByteArray, places: FloatArray) -> ByteArray:
    """(s, 3) sRGB of a photo (h, w, 3) at places (s, 2), shares of its width and height."""
    import cv2

    if not len(places):
        return np.zeros((0, 3), np.uint8)
    at = (places * pixels.shape[1::-1] - 0.5).astype(np.float32)[:, None]
    return np.asarray(cv2.remap(pixels, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))[:, 0]
