"""PLY files: meshes and point clouds with normals and colours, as scanners and photogrammetry write them.

A reader of our own, since trimesh's refuses binary files whose faces differ in size, follows counts of the header
without a bound, splits points by texture coordinates, knows fewer kinds of colours and lets NaN through. Elements
other than ``vertex`` and ``face`` are skipped. Format: Turk, "The PLY Polygon File Format", 1994; property names as
MeshLab, CloudCompare, Open3D and Blender write them.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.atomic import replacing
from facepipe.core.errors import InputError
from facepipe.core.reading import read_bytes
from facepipe.geometry.colors import from_srgb, to_srgb
from facepipe.geometry.polygons import point_triangles
from facepipe.importers.ply_elements import Columns, Element, Lists, read_elements
from facepipe.importers.wavefront import LARGEST
from facepipe.scans import Scan, no_triangles

MOST_BYTES = 1 << 31
_COLORS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
_FACES = ("vertex_indices", "vertex_index")


def read_ply(path: Path) -> Scan:
    """The points of `path`, with its triangles where it has faces.

    Faces of any size become fans of triangles. Colours are sRGB in the file: whole numbers over the range of their
    type, or floats in 0..1. Normals are made unit length; where one is not, all are left out.

    :raises InputError: no PLY, cut short, without points, indices out of range, NaN or infinity
    """
    elements = read_elements(path, read_bytes(path, MOST_BYTES))
    vertices = elements.get("vertex")
    if vertices is None or vertices.count == 0:
        raise InputError(path, "no vertices, expected a PLY mesh or point cloud")
    points = _columns(vertices, ("x", "y", "z"))
    if points is None:
        raise InputError(f"{path} -> vertex", "lacks x, y or z, expected all three")
    _check(f"{path} -> vertex", points)
    return Scan(
        name=path.stem,
        points=points,
        triangles=_triangles(path, elements, len(points)),
        normals=_normals(path, vertices),
        colors=_colors(path, vertices),
    )


def write_ply(scan: Scan, path: Path) -> None:
    """Write `scan` as binary little-endian PLY: float32 points and normals, 8-bit sRGB colours; whole or not at all.

    :raises InputError: the file can't be written, or a number is not finite in float32
    """
    fields: list[tuple[str, str, FloatArray | IntArray]] = _written(scan.points, "x y z")
    if scan.normals is not None:
        fields += _written(scan.normals, "nx ny nz")
    for name, _, values in fields:
        if not np.isfinite(values).all():
            raise InputError(f"{path} -> {name}", "NaN, infinity or beyond float32, expected finite numbers")
    if scan.colors is not None:
        levels = np.rint(to_srgb(scan.colors) * 255).astype(np.uint8)
        fields += [(name, "uchar", levels[:, i]) for i, name in enumerate(("red", "green", "blue"))]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(scan.points)}"]
    header += [f"property {kind} {name}" for name, kind, _ in fields]
    rows = np.empty(len(scan.points), [(name, "<f4" if kind == "float" else "u1") for name, kind, _ in fields])
    for name, _, values in fields:
        rows[name] = values
    data = rows.tobytes()
    if not scan.is_cloud:
        header += [f"element face {len(scan.triangles)}", "property list uchar int vertex_indices"]
        faces = np.empty(len(scan.triangles), [("count", "u1"), ("corners", "<i4", 3)])
        faces["count"], faces["corners"] = 3, scan.triangles
        data += faces.tobytes()
    with replacing(path) as temporary:
        temporary.write_bytes("\n".join([*header, "end_header", ""]).encode("ascii") + data)


def _written(values: FloatArray, names: str) -> list[tuple[str, str, FloatArray | IntArray]]:
    with np.errstate(over="ignore"):
        narrow = np.asarray(values, np.float32)
    return [(name, "float", narrow[:, i]) for i, name in enumerate(names.split())]


def _triangles(path: Path, elements: dict[str, Element], count: int) -> IntArray:
    if "tristrips" in elements:
        raise InputError(f"{path} -> tristrips", "triangle strips, expected faces: save it as triangles")
    faces = elements.get("face")
    if faces is None or faces.count == 0:
        return no_triangles()
    lists = next((faces.values[name] for name in _FACES if name in faces.values), None)
    if not isinstance(lists, Lists):
        raise InputError(f"{path} -> face", "no list vertex_indices, expected the corners of each face")
    used = lists.values
    if len(used) and (used.min() < 0 or used.max() >= count):
        at = int(np.argmax((used < 0) | (used >= count)))
        face = int(np.searchsorted(np.cumsum(lists.counts), at, side="right"))
        raise InputError(f"{path} -> face {face}", f"vertex {used[at]}, expected 0 to {count - 1}")
    return np.asarray(point_triangles(lists.counts, used.astype(np.int64)), np.int32)


def _normals(path: Path, vertices: Element) -> FloatArray | None:
    normals = _columns(vertices, ("nx", "ny", "nz"))
    if normals is None:
        return None
    _check(f"{path} -> vertex normals", normals)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.asarray(normals / lengths) if (lengths > 0).all() else None


def _colors(path: Path, vertices: Element) -> FloatArray | None:
    for names in _COLORS:
        found = _scalars(vertices, names)
        if found is not None:
            tops = [np.iinfo(one.dtype).max if one.dtype.kind in "iu" else 1.0 for one in found]
            values = np.stack([one / top for one, top in zip(found, tops, strict=True)], axis=1)
            _check(f"{path} -> vertex colours", values)
            return from_srgb(np.clip(values, 0.0, 1.0))
    return None


def _scalars(element: Element, names: tuple[str, ...]) -> list[Columns] | None:
    """The values of scalar properties; None where one is not there."""
    values = [element.values.get(name) for name in names]
    found = [value for value in values if value is not None and not isinstance(value, Lists)]
    return found if len(found) == len(names) else None


def _columns(element: Element, names: tuple[str, ...]) -> FloatArray | None:
    """(n, 3) float64 of three scalar properties; None where one is not there."""
    found = _scalars(element, names)
    return None if found is None else np.stack(found, axis=1).astype(np.float64)


def _check(where: str, values: FloatArray) -> None:
    """:raises InputError: a row that is not finite"""
    good = (np.abs(values) <= LARGEST).all(axis=1)
    if not good.all():
        row = int(np.argmin(good))
        raise InputError(f"{where} {row}", f"NaN, infinity or over {LARGEST:g}, expected finite numbers")
