"""The skin's template: where each texel of its two tiles lies, and what kind of skin it is.

usage: python samples/head/skin_maps.py ict_facekit.npz facepipe/heads/data/skin_maps.npz

Positions and masks are painted on ICT-FaceKit's neutral, so that they hold for all its identities; masks are functions
of the surface point, so that the two tiles agree where they meet.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from packing import write_arrays
from scipy.interpolate import CubicSpline, PchipInterpolator
from scipy.ndimage import distance_transform_edt, gaussian_filter
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from facepipe.geometry.polygons import point_normals, triangulate
from facepipe.pictures.occlusion import ambient_occlusion

Array = Any
POINTS, FACES = 14062, 14034  # the welded skin: face, head and neck, mouth socket, eye sockets
FACE, BACK, MOUTH, SOCKETS = range(9230), range(9230, 11144), range(11144, 13226), range(13226, 14034)
SIZE = 512  # texels a side
OUTER_LIPS = [5708, 5695, 2081, 0, 4275, 6200, 6213, 6346, 6461, 5518, 5957, 5841]
BROW_LEFT = [3615, 4240, 4114, 2734, 2509]  # landmarks, from the middle outwards
# Hairline: height over the azimuth from the face's middle, around the axis x = 0, z = 0.5.
HAIR_ANGLE = np.radians([0, 14, 28, 40, 50, 58, 66, 76, 84, 92, 104, 125, 150, 180])
HAIR_HEIGHT = [11.3, 11.25, 11.0, 10.0, 8.3, 6.6, 4.4, 3.0, 2.9, 3.6, 2.5, -1.0, -3.4, -4.0]


class Template:
    """ICT-FaceKit's neutral skin."""

    def __init__(self, source: Path) -> None:
        data = np.load(source)
        corners = int(data["face_vertex_counts"][:FACES].sum())
        self.points = data["neutral"][:POINTS].astype(float)
        self.counts = data["face_vertex_counts"][:FACES]
        self.indices = data["face_vertex_indices"][:corners]
        self.uv = data["uv"].astype(float)
        self.uv_indices = data["face_uv_indices"][:corners]
        places, self.face = triangulate(self.counts)
        self.triangles, self.uv_triangles = self.indices[places], self.uv_indices[places]
        self.normals = point_normals(self.points, self.triangles)

    def distance(self, start: Array) -> Array:
        """(n,) way along edges from the nearest of the `start` points."""
        edges = np.concatenate([self.triangles[:, [0, 1]], self.triangles[:, [1, 2]], self.triangles[:, [2, 0]]])
        length = np.linalg.norm(self.points[edges[:, 0]] - self.points[edges[:, 1]], axis=1)
        graph = coo_array((length, edges.T), (POINTS, POINTS)).tocsr()
        return dijkstra(graph, directed=False, indices=start, min_only=True)

    def used(self, faces: range) -> Array:
        """Points of faces."""
        of_face = np.repeat(np.arange(FACES), self.counts)
        return np.unique(self.indices[(of_face >= faces.start) & (of_face < faces.stop)])


def step(low: float, high: float, value: Array) -> Array:
    """0 at `low`, 1 at `high`, smooth between."""
    t = np.clip((value - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def bump(points: Array, middle: tuple[float, float, float], radii: tuple[float, float, float]) -> Array:
    """A Gaussian on both sides of the face."""
    away = np.column_stack([np.abs(points[:, 0]), points[:, 1:]]) - middle
    return np.exp(-((away / radii) ** 2).sum(axis=1))


def above_hairline(points: Array) -> Array:
    """(n,) height above the hairline."""
    angle = np.abs(np.arctan2(points[:, 0], points[:, 2] - 0.5))
    return points[:, 1] - PchipInterpolator(HAIR_ANGLE, HAIR_HEIGHT)(angle)


def brow_curve(points: Array) -> tuple[Array, Array]:
    """The left brow's middle line (m, 3), from the nose outwards, and half its height at each place."""
    t = np.linspace(0, 1, 200)
    line = CubicSpline(np.linspace(0, 1, 5), points[BROW_LEFT])(t) - [0, 0.55, 0]
    return line, 0.42 * np.interp(t, [0, 0.12, 0.5, 0.8, 1.0], [0.72, 1.0, 0.95, 0.6, 0.18])


def lip_distance(template: Template) -> Array:
    """(n,) distance of points from the lips' outline, cm, negative on the lips and inside the mouth."""
    t, fine = np.linspace(0, 1, 13), np.linspace(0, 1, 400)
    loop = [*OUTER_LIPS, OUTER_LIPS[0]]
    at = np.zeros(POINTS, int)
    face_corners = slice(0, template.counts[: FACE.stop].sum())
    at[template.indices[face_corners]] = template.uv_indices[face_corners]
    outline = CubicSpline(t, template.points[loop], bc_type="periodic")(fine)
    away = cKDTree(outline).query(template.points)[0]
    inside = contains(CubicSpline(t, template.uv[at[loop]], bc_type="periodic")(fine), template.uv[at])
    mouth = np.zeros(POINTS, bool)
    mouth[template.used(MOUTH)] = True
    return np.where(inside | mouth, -away, away)


def contains(outline: Array, at: Array) -> Array:
    """(n,) whether places lie within a closed line: it is crossed an odd number of times."""
    a, b = outline[:-1], outline[1:]
    rising = (a[:, 1] > at[:, None, 1]) != (b[:, 1] > at[:, None, 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        x = a[:, 0] + (at[:, None, 1] - a[:, 1]) * (b[:, 0] - a[:, 0]) / (b[:, 1] - a[:, 1])
    return (rising & (at[:, None, 0] < x)).sum(axis=1) % 2 == 1


def masks(template: Template) -> dict[str, Array]:
    """Kinds of skin by name: (n,) 0..1 of each point."""
    p = template.points
    lips, mouth = lip_distance(template), template.distance(np.intersect1d(template.used(FACE), template.used(MOUTH)))
    rim = template.distance(np.intersect1d(template.used(FACE), template.used(SOCKETS)))
    flesh, socket = np.zeros(POINTS), np.zeros(POINTS)
    flesh[np.setdiff1d(template.used(MOUTH), template.used(FACE))] = 1
    socket[np.setdiff1d(template.used(SOCKETS), template.used(FACE))] = 1
    inside = flesh + socket
    hair = above_hairline(p)
    x, y, z = np.abs(p[:, 0]), p[:, 1], p[:, 2]
    ear = step(7.35, 7.75, x) * step(4.0, 3.5, y) * step(-2.6, -2.2, y) * step(-2.4, -1.6, z) * step(2.3, 1.6, z)
    scalp = step(-0.5, 0.9, hair) * (1 - step(0.12, 0.35, bump(p, (8.0, 0.9, -0.1), (1.3, 2.4, 1.5))))
    line, half = brow_curve(p)
    away, nearest = cKDTree(line).query(np.column_stack([x, p[:, 1:]]))
    beard_top = np.interp(z, [3.0, 5.0, 8.5, 10.5, 12], [1.0, -1.2, -2.3, -1.7, -1.5])
    beard = step(0.4, -0.5, y - beard_top) * step(2.0, 3.6, z + 0.35 * (y + 2)) * step(-10.5, -8.3, y)
    beard *= step(0.0, 0.25, lips) * (1 - ear)
    return {
        "lips": step(0.10, -0.12, lips) * (1 - socket),
        "lip_line": np.exp(-mouth / 0.22),
        "mouth": step(0.15, 1.3, mouth) * flesh,
        "cheeks": bump(p, (4.5, -0.2, 9.0), (2.3, 2.0, 2.5)),
        "nose": np.maximum(
            bump(p, (0.0, 0.3, 13.0), (1.5, 1.2, 1.6)), 0.9 * bump(p, (1.6, -0.2, 11.2), (0.9, 0.9, 1.0))
        ),
        "bridge": bump(p, (0.0, 2.2, 11.6), (1.4, 2.4, 2.0)),
        "under_eye": bump(p, (2.9, 2.25, 9.6), (1.6, 0.62, 1.6)) * step(0.05, 0.35, rim),
        "lid": step(1.5, 0.45, rim) * (1 - inside) * np.where(y > 3.4, 1, 0.55),
        "rim": step(0.40, 0.24, rim) * (1 - inside),
        "socket": socket,
        # the mesh bulges at the inner corner, between where the upper lid's margin ends and where the lower one's does
        "caruncle": step(0.4, 0.75, bump(p, (2.0, 3.34, 9.16), (0.17, 0.21, 0.3))) * (1 - inside),
        # the lower margin out to its edge: from the front, its inner part is behind it
        "wet_line": step(0.38, 0.28, rim) * step(3.42, 3.34, y) * (1 - inside),
        "ears": ear,
        "forehead": bump(p, (0.0, 9.0, 10.0), (5.0, 2.6, 4.0)),
        "chin": bump(p, (0.0, -6.6, 10.9), (1.9, 1.4, 1.8)),
        "beard": beard,
        "moustache": beard * step(-4.0, -3.2, y) * step(3.2, 2.2, x),
        "brows": step(1.25, 0.35, away / half[nearest]),
        "scalp": scalp,
        "neck": step(-8.0, -10.5, y),
        "open": ambient_occlusion(p, template.normals, template.triangles),
    }


def baked(template: Template, tile: int, values: Array, size: int) -> Array:
    """(size, size, c) values of the points (n, c) over a tile, top row first; the outside takes the nearest texel."""
    picture, known = np.zeros((size, size, values.shape[1])), np.zeros((size, size), bool)
    flat = (template.uv - [tile, 0]) * size
    flat[:, 1] = size - flat[:, 1]
    for points, corners in zip(template.triangles, template.uv_triangles, strict=True):
        a, b, c = flat[corners]
        low = np.floor(np.min([a, b, c], axis=0) - 0.5).astype(int)
        high = np.ceil(np.max([a, b, c], axis=0) + 0.5).astype(int)
        if low.min() < -2 or high.max() > size + 2:
            continue  # another tile's
        y, x = np.mgrid[max(low[1], 0) : min(high[1], size), max(low[0], 0) : min(high[0], size)]
        at = np.stack([x + 0.5, y + 0.5], axis=-1) - a
        matrix = np.column_stack([b - a, c - a])
        if abs(np.linalg.det(matrix)) < 1e-12:
            continue
        two = at @ np.linalg.inv(matrix).T
        shares = np.concatenate([1 - two.sum(axis=-1, keepdims=True), two], axis=-1)
        covered = shares.min(axis=-1) > -1e-6
        picture[y[covered], x[covered]] = shares[covered] @ values[points]
        known[y[covered], x[covered]] = True
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    return picture[tuple(nearest)]


def main(source: Path, target: Path) -> None:
    """Bake and save."""
    template = Template(source)
    painted = masks(template)
    values = np.column_stack(list(painted.values()))
    arrays: dict[str, Array] = {"names": np.array(list(painted))}
    for number, name in enumerate(("face", "back")):
        texels = baked(template, number, np.column_stack([template.points, values]), SIZE)
        arrays[f"{name}_masks"] = (gaussian_filter(texels[..., 3:], (0.6, 0.6, 0)) * 255 + 0.5).astype(np.uint8)
        arrays[f"{name}_places"] = texels[::2, ::2, :3].astype(np.float16)
    write_arrays(target, arrays)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
