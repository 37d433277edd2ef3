"""Points of all photos as one cloud, and a surface through it.

Points are averaged, with normals and colours, without what stands apart; the surface is screened Poisson reconstruction
(COLMAP's build of it), cut where no points are.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.errors import FitError
from facepipe.geometry.colors import from_srgb
from facepipe.geometry.polygons import components, edges, point_normals
from facepipe.geometry.vectors import group_sums
from facepipe.scanning.photos.cameras import PhotoCamera
from facepipe.scanning.photos.depth import confirmed
from facepipe.scanning.photos.options import ScanPhotosOptions
from facepipe.scanning.photos.photos import Photo
from facepipe.scanning.photos.structure import Subject, colmap_module
from facepipe.scans import Scan

_AROUND = 24  # points that a normal is fitted to
_LINKED = 6  # neighbours that a point hangs together with, and ...
_LINK = 4.0  # ... how far at most, in distances of points
_FEWEST = 500  # points of a scan
_DEEPEST, _SHALLOWEST = 11, 6  # of the octree
_WITHIN = 2.5  # distances of points a cell of the octree has, about
_COLORED = 4  # nearest points that colour a point of the surface
_VERTEX = np.dtype([("place", "<f4", 3), ("normal", "<f4", 3), ("color", "u1", 3)])
_FACE = np.dtype([("count", "<i4"), ("points", "<i4", 3)])  # of the surface, all triangles
_PROPERTIES = ("x", "y", "z", "nx", "ny", "nz")
_COLORS = ("red", "green", "blue")


@dataclass(frozen=True, kw_only=True)
class Cloud:
    """Points with normals and colours."""

    points: FloatArray  # (n, 3)
    normals: FloatArray  # (n, 3) unit, towards the cameras
    colors: FloatArray  # (n, 3) linear 0..1
    spacing: float  # distance of the points, scan units

    def only(self, kept: BoolArray) -> Cloud:
        """The points marked in `kept` (n,)."""
        arrays = {field.name: getattr(self, field.name)[kept] for field in fields(self) if field.name != "spacing"}
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
    spacing = options.spacing * float(
        np.median([np.linalg.norm(camera.eye - subject.center) / camera.focal[0] for camera in cameras])
    )
    rows = []
    for number, (photo, camera) in enumerate(zip(photos, cameras, strict=True)):
        step()
        points, pixels, off = confirmed(number, maps, cameras, subject, options.agreement, options.support)
        color = from_srgb(photo.pixels[pixels[:, 1], pixels[:, 0]] / 255.0)
        towards = camera.eye - points
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        rows.append(np.c_[points, towards, color, off])
    values = np.concatenate(rows)
    if len(values) < _FEWEST:
        raise FitError(
            "photos", f"they agree on {len(values)} points, expected {_FEWEST} or more: sharp photos, more overlap"
        )
    apart = float(np.median(values[:, 9]))
    # means of the points in one cube of edge `spacing`
    cell = np.floor((values[:, :3] - values[:, :3].min(axis=0)) / spacing).astype(np.int64)
    shape = cell.max(axis=0) + 1
    key = (cell[:, 0] * shape[1] + cell[:, 1]) * shape[2] + cell[:, 2]
    _, group, counts = np.unique(key, return_inverse=True, return_counts=True)
    mean = np.asarray(group_sums(group.ravel(), values[:, :9], len(counts)) / counts[:, None])
    normals = _normals(mean[:, :3], mean[:, 3:6])
    cloud = Cloud(points=mean[:, :3], normals=normals, colors=np.clip(mean[:, 6:], 0.0, 1.0), spacing=spacing)
    return clean(cloud, options.outliers, options.smallest), apart


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


def make_surface(cloud: Cloud, name: str, *, gap: float, smallest: float) -> Scan:
    """The scan: the Poisson surface of a cloud, without what is farther from its points than `gap` spacings.

    Kazhdan and Hoppe, "Screened Poisson surface reconstruction", TOG 2013.

    :param smallest: least share of the triangles that a loose piece must have
    :raises FitError: no surface is left
    """
    from scipy.spatial import cKDTree

    points, triangles = _poisson(cloud)
    tree = cKDTree(cloud.points)
    distance, _ = tree.query(points, distance_upper_bound=gap * cloud.spacing)
    triangles = triangles[np.isfinite(distance)[triangles].all(axis=1)]
    if not len(triangles):
        raise FitError("photos", f"no surface through {len(cloud.points)} points: sharp photos, more overlap")
    pairs, _ = edges(np.full(len(triangles), 3), triangles.ravel())
    piece = components(len(points), pairs)[triangles[:, 0]]
    size = np.bincount(piece)
    triangles = triangles[size[piece] >= min(smallest * len(triangles), size.max())]
    used, local = np.unique(triangles, return_inverse=True)
    points, triangles = points[used], local.reshape(-1, 3)
    # colours: means of the nearest points', by nearness
    distance, near = tree.query(points, k=min(_COLORED, len(cloud.points)))
    share = 1.0 / (distance.reshape(len(points), -1) + 0.25 * cloud.spacing)
    share /= share.sum(axis=1, keepdims=True)
    return Scan(
        name=name,
        points=points,
        triangles=triangles.astype(np.int32),
        normals=point_normals(points, triangles),
        colors=np.asarray(np.einsum("nk,nkc->nc", share, cloud.colors[near.reshape(len(points), -1)])),
    )


def _poisson(cloud: Cloud) -> tuple[FloatArray, IntArray]:
    pycolmap = colmap_module()
    center, extent = cloud.points.mean(axis=0), float(np.ptp(cloud.points, axis=0).max())
    options = pycolmap.PoissonMeshingOptions()
    # Depth d cuts the extent into 2^d cells.
    options.depth = int(np.clip(np.ceil(np.log2(extent / cloud.spacing / _WITHIN)), _SHALLOWEST, _DEEPEST))
    options.trim, options.color, options.num_threads = 0.0, False, 1
    with tempfile.TemporaryDirectory(prefix="facepipe-scan-") as folder:
        points, mesh = Path(folder) / "points.ply", Path(folder) / "mesh.ply"
        rows = np.zeros(len(cloud.points), _VERTEX)
        rows["place"], rows["normal"] = (cloud.points - center) / extent, cloud.normals
        header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
        header += [f"property float {one}" for one in _PROPERTIES]
        header += [f"property uchar {one}" for one in _COLORS]
        points.write_bytes("\n".join([*header, "end_header", ""]).encode() + rows.tobytes())
        try:
            pycolmap.poisson_meshing(points, mesh, options)
            data = mesh.read_bytes()
            end = data.index(b"end_header\n") + len(b"end_header\n")
            counts, kinds, element = {}, [], ""
            for line in data[:end].decode("ascii").splitlines():
                words = line.split()
                if words[0] == "element":
                    element = words[1]
                    counts[element] = int(words[2])
                elif words[0] == "property" and element == "vertex":
                    kinds.append((words[2], {"float": "<f4", "double": "<f8", "uchar": "u1"}[words[1]]))
            places = np.frombuffer(data, np.dtype(kinds), counts["vertex"], end)
            faces = np.frombuffer(data, _FACE, counts["face"], end + places.nbytes)
            if (faces["count"] != 3).any():
                raise ValueError("the surface has faces that are no triangles")
            vertices = np.stack([places[axis] for axis in "xyz"], axis=1).astype(np.float64)
        except (RuntimeError, ValueError, OSError) as error:
            raise FitError("photos", f"Poisson reconstruction gave up: {str(error)[:200]}") from error
    return vertices * extent + center, faces["points"].astype(np.int64)
