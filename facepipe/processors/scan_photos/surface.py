"""A surface through a cloud: screened Poisson reconstruction (COLMAP's build of it), cut where no points are."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import FitError, InputError
from facepipe.geometry.polygons import components, edges, point_normals
from facepipe.processors.scan_photos.cloud import Cloud
from facepipe.scans import Scan

_DEEPEST, _SHALLOWEST = 11, 6  # of the octree
_WITHIN = 2.5  # distances of points a cell of the octree has, about
_COLORED = 4  # nearest points that colour a point of the surface
_VERTEX = np.dtype([("place", "<f4", 3), ("normal", "<f4", 3), ("color", "u1", 3)])
_PROPERTIES = ("x", "y", "z", "nx", "ny", "nz")
_COLORS = ("red", "green", "blue")


class Surface(NamedTuple):
    """Triangles of points."""

    points: FloatArray  # (n, 3)
    triangles: IntArray  # (t, 3)


def make_surface(cloud: Cloud, name: str, *, gap: float, smallest: float) -> Scan:
    """The scan: the Poisson surface of a cloud, without what is farther from its points than `gap` spacings.

    Kazhdan and Hoppe, "Screened Poisson surface reconstruction", TOG 2013.

    :param smallest: least share of the triangles that a loose piece must have
    :raises FitError: no surface is left
    """
    surface = _near(_poisson(cloud), cloud, gap, smallest)
    if not len(surface.triangles):
        raise FitError("photos", f"no surface through {len(cloud.points)} points: sharp photos, more overlap")
    return Scan(
        name=name,
        points=surface.points,
        triangles=surface.triangles.astype(np.int32),
        normals=point_normals(surface.points, surface.triangles),
        colors=_colors(surface.points, cloud),
    )


def _poisson(cloud: Cloud) -> Surface:
    try:
        import pycolmap
    except ImportError as error:
        raise InputError("pycolmap", "is not installed, expected `pip install 'facepipe[scan]'`") from error
    center, extent = cloud.points.mean(axis=0), float(np.ptp(cloud.points, axis=0).max())
    options = pycolmap.PoissonMeshingOptions()
    options.depth = int(np.clip(np.ceil(np.log2(extent / cloud.spacing / _WITHIN)), _SHALLOWEST, _DEEPEST))
    options.trim, options.color, options.num_threads = 0.0, False, 1
    with tempfile.TemporaryDirectory(prefix="facepipe-scan-") as folder:
        points, mesh = Path(folder) / "points.ply", Path(folder) / "mesh.ply"
        _write_points(points, (cloud.points - center) / extent, cloud.normals)
        try:
            pycolmap.poisson_meshing(points, mesh, options)
            surface = _read_mesh(mesh)
        except (RuntimeError, ValueError, OSError) as error:
            raise FitError("photos", f"Poisson reconstruction gave up: {str(error)[:200]}") from error
    return Surface(surface.points * extent + center, surface.triangles)


def _write_points(path: Path, points: FloatArray, normals: FloatArray) -> None:
    rows = np.zeros(len(points), _VERTEX)
    rows["place"], rows["normal"] = points, normals
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    header += [f"property float {one}" for one in _PROPERTIES]
    header += [f"property uchar {one}" for one in _COLORS]
    path.write_bytes("\n".join([*header, "end_header", ""]).encode() + rows.tobytes())


def _read_mesh(path: Path) -> Surface:
    """The mesh as Poisson reconstruction writes it: triangles, and points of floats."""
    data = path.read_bytes()
    end = data.index(b"end_header\n") + len(b"end_header\n")
    counts, kinds, element = {}, [], ""
    for line in data[:end].decode("ascii").splitlines():
        words = line.split()
        if words[0] == "element":
            element = words[1]
            counts[element] = int(words[2])
        elif words[0] == "property" and element == "vertex":
            kinds.append((words[2], {"float": "<f4", "double": "<f8", "uchar": "u1"}[words[1]]))
    vertex, face = np.dtype(kinds), np.dtype([("count", "<i4"), ("points", "<i4", 3)])
    rows = np.frombuffer(data, vertex, counts["vertex"], end)
    faces = np.frombuffer(data, face, counts["face"], end + rows.nbytes)
    if (faces["count"] != 3).any():
        raise ValueError("the surface has faces that are no triangles")
    points = np.stack([rows[axis] for axis in "xyz"], axis=1).astype(np.float64)
    return Surface(points, faces["points"].astype(np.int64))


def _near(surface: Surface, cloud: Cloud, gap: float, smallest: float) -> Surface:
    """The parts near the cloud, without small loose pieces, and only the points that are used."""
    from scipy.spatial import cKDTree

    distance, _ = cKDTree(cloud.points).query(surface.points, distance_upper_bound=gap * cloud.spacing)
    triangles = surface.triangles[np.isfinite(distance)[surface.triangles].all(axis=1)]
    if not len(triangles):
        return Surface(surface.points[:0], triangles)
    pairs, _ = edges(np.full(len(triangles), 3), triangles.ravel())
    piece = components(len(surface.points), pairs)[triangles[:, 0]]
    size = np.bincount(piece)
    triangles = triangles[size[piece] >= min(smallest * len(triangles), size.max())]
    used, local = np.unique(triangles, return_inverse=True)
    return Surface(surface.points[used], local.reshape(-1, 3))


def _colors(points: FloatArray, cloud: Cloud) -> FloatArray:
    """(n, 3) means of the nearest points' colours, by nearness."""
    from scipy.spatial import cKDTree

    distance, near = cKDTree(cloud.points).query(points, k=min(_COLORED, len(cloud.points)))
    share = 1.0 / (distance.reshape(len(points), -1) + 0.25 * cloud.spacing)
    share /= share.sum(axis=1, keepdims=True)
    return np.asarray(np.einsum("nk,nkc->nc", share, cloud.colors[near.reshape(len(points), -1)]))
