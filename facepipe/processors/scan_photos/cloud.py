"""Points of all photos as one cloud: averaged, with normals and colours, without what stands apart."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import FitError
from facepipe.geometry.colors import from_srgb
from facepipe.geometry.polygons import components
from facepipe.geometry.vectors import group_sums
from facepipe.processors.scan_photos.camera import PhotoCamera
from facepipe.processors.scan_photos.depth import confirmed
from facepipe.processors.scan_photos.options import ScanPhotosOptions
from facepipe.processors.scan_photos.photos import Photo
from facepipe.processors.scan_photos.subject import Subject

_AROUND = 24  # points that a normal is fitted to
_LINKED = 6  # neighbours that a point hangs together with, and ...
_LINK = 4.0  # ... how far at most, in distances of points
_FEWEST = 500  # points of a scan


@dataclass(frozen=True, kw_only=True)
class Cloud:
    """Points with normals and colours."""

    points: FloatArray  # (n, 3)
    normals: FloatArray  # (n, 3) unit, towards the cameras
    colors: FloatArray  # (n, 3) linear 0..1
    spacing: float  # distance of the points, scan units

    def only(self, kept: npt.NDArray[np.bool_]) -> Cloud:
        """The points marked in `kept` (n,)."""
        arrays = {one.name: getattr(self, one.name)[kept] for one in fields(self) if one.name != "spacing"}
        return Cloud(spacing=self.spacing, **arrays)


def make_cloud(
    photos: Sequence[Photo],
    cameras: Sequence[PhotoCamera],
    maps: Sequence[FloatArray],
    subject: Subject,
    options: ScanPhotosOptions,
    step: Callable[[], None],
) -> tuple[Cloud, float]:
    """The cloud of confirmed points, and the median distance between the surfaces of different photos, scan units.

    :param step: called before every photo
    :raises FitError: too few points that photos agree on
    """
    spacing = options.spacing * _pixel_width(cameras, subject)
    found = []
    for number, (photo, camera) in enumerate(zip(photos, cameras, strict=True)):
        step()
        seen = confirmed(number, maps, cameras, subject, options.agreement, options.support)
        color = from_srgb(photo.pixels[seen.pixels[:, 1], seen.pixels[:, 0]] / 255.0)
        towards = camera.eye - seen.points
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        found.append(np.c_[seen.points, towards, color, seen.apart])
    values = np.concatenate(found)
    if len(values) < _FEWEST:
        raise FitError(
            "photos", f"they agree on {len(values)} points, expected {_FEWEST} or more: sharp photos, more overlap"
        )
    apart = float(np.median(values[:, 9]))
    mean = _voxel_means(values[:, :9], spacing)
    normals = _normals(mean[:, :3], mean[:, 3:6])
    cloud = Cloud(points=mean[:, :3], normals=normals, colors=np.clip(mean[:, 6:], 0.0, 1.0), spacing=spacing)
    return clean(cloud, options.outliers, options.smallest), apart


def _pixel_width(cameras: Sequence[PhotoCamera], subject: Subject) -> float:
    """How wide a pixel is on the subject, of the median camera."""
    return float(np.median([np.linalg.norm(one.eye - subject.center) / one.focal[0] for one in cameras]))


def _voxel_means(values: FloatArray, size: float) -> FloatArray:
    """(m, k) means of the rows (n, k) whose first three are in one cube of edge `size`."""
    low = values[:, :3].min(axis=0)
    cell = np.floor((values[:, :3] - low) / size).astype(np.int64)
    shape = cell.max(axis=0) + 1
    key = (cell[:, 0] * shape[1] + cell[:, 1]) * shape[2] + cell[:, 2]
    _, group, counts = np.unique(key, return_inverse=True, return_counts=True)
    return np.asarray(group_sums(group.ravel(), values, len(counts)) / counts[:, None])


def _normals(points: FloatArray, towards: FloatArray) -> FloatArray:
    """(n, 3) unit normals of planes through each point's neighbours, on the side of `towards` (n, 3)."""
    from scipy.spatial import cKDTree

    _, near = cKDTree(points).query(points, k=min(_AROUND, len(points)))
    normals = np.empty_like(points)
    for start in range(0, len(points), 100_000):
        at = slice(start, start + 100_000)
        around = points[near[at]]
        around = around - around.mean(axis=1, keepdims=True)
        normals[at] = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))[1][:, :, 0]
    facing = np.einsum("nc,nc->n", normals, towards)
    return np.where(facing[:, None] < 0, -normals, normals)


def clean(cloud: Cloud, outliers: float, smallest: float) -> Cloud:
    """The cloud without points far from their neighbours, then without loose pieces.

    Rusu et al., "Towards 3D point cloud based object maps", 2008, section 3.2 (statistical outliers).

    :param outliers: standard deviations above the mean distance from the neighbours
    :param smallest: least share of the points that a piece must have
    """
    from scipy.spatial import cKDTree

    distance, _ = cKDTree(cloud.points).query(cloud.points, k=min(_LINKED + 1, len(cloud.points)))
    mean = distance[:, 1:].mean(axis=1)
    cloud = cloud.only(mean <= mean.mean() + outliers * mean.std())
    distance, near = cKDTree(cloud.points).query(cloud.points, k=min(_LINKED + 1, len(cloud.points)))
    first, rank = np.nonzero((distance <= _LINK * cloud.spacing) & (np.arange(near.shape[1]) > 0))
    piece = components(len(cloud.points), np.stack([first, near[first, rank]], axis=1))
    size = np.bincount(piece)
    return cloud.only(size[piece] >= min(smallest * len(piece), size.max()))
