"""Photos of known faces: pictures of a painted head from cameras that are known, as a ring of cameras would take them.

The paint is noise in the head's own space, from blotches to pores, so that photos show a point of the skin alike from
everywhere; lamps stand still while the camera moves. Millimetres, Y up; cameras as `facepipe scan` describes them.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image
from scan_actors import ict
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from trimesh.triangles import points_to_barycentric

from facepipe.geometry.closest_points import closest_places
from facepipe.geometry.colors import to_srgb
from facepipe.geometry.polygons import point_normals
from facepipe.geometry.rasterise import barycentrics, rasterise, screen_triangles
from facepipe.scanning.photos import PhotoCamera

FloatArray = npt.NDArray[np.floating]
IntArray = npt.NDArray[np.integer]

CENTRE = np.array([0.0, 5.0, 40.0])  # mm: what the cameras look at
_DISTANCE = 900.0  # mm
_CLEAR_PARTS = tuple(range(9, 17))  # fluid, blends, occlusion, lashes
_EYEBALLS = ((21451, 23021), (23021, 24591))  # points
_SKIN, _SCLERA, _IRIS = (0.62, 0.40, 0.31), (0.75, 0.72, 0.70), (0.16, 0.10, 0.06)  # linear
_LAMPS = (((0.5, 0.7, 0.8), 0.55), ((-0.8, 0.2, 0.6), 0.30), ((0.1, -0.6, 0.5), 0.15))
_AMBIENT = 0.35
_CELLS = 96  # of a block of noise, which repeats
_OCTAVES = ((24.0, 0.10), (7.0, 0.10), (2.4, 0.14), (1.0, 0.16))  # mm a cell, contrast


def ring(
    yaws: Sequence[float], pitches: Sequence[float], *, width: int = 960, height: int = 1152, fill: float = 0.82
) -> dict[str, PhotoCamera]:
    """Cameras around the face, yaw and pitch in degrees; `fill`: the head's share of the height of a photo."""
    focal = fill * height * _DISTANCE / 330.0
    found = {}
    for pitch in pitches:
        for yaw in yaws:
            camera = _camera(np.radians(yaw), np.radians(pitch), focal, width, height)
            found[f"photo{len(found):02d}.png"] = camera
    return found


def _camera(yaw: float, pitch: float, focal: float, width: int, height: int) -> PhotoCamera:
    backward = np.array([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)])
    right = np.array([np.cos(yaw), 0.0, -np.sin(yaw)])
    rotation = np.stack([right, -np.cross(backward, right), -backward])  # x right, y down, z forward
    eye = CENTRE + _DISTANCE * (1.0 + 0.03 * np.sin(5.0 * yaw + 3.0 * pitch)) * backward
    return PhotoCamera(
        width=width,
        height=height,
        focal=(focal, focal),
        center=(width / 2, height / 2),
        rotation=rotation,
        translation=-rotation @ eye,
    )


def solid_triangles() -> IntArray:
    """(t, 3) triangles of the parts that are not clear."""
    model = ict()
    part = np.searchsorted(model.part_faces[:, 1], model.triangle_faces, side="right")
    return np.asarray(model.triangles[~np.isin(part, _CLEAR_PARTS)])


def photograph(points: FloatArray, camera: PhotoCamera, *, seed: int = 0, samples: int = 2) -> FloatArray:
    """(h, w, 3) uint8 sRGB of a face of ICT points (n, 3), millimetres."""
    triangles = solid_triangles()
    normals = point_normals(points, triangles)
    width, height = samples * camera.width, samples * camera.height
    local = points @ camera.rotation.T + camera.translation
    w = local[:, 2]
    x = samples * (camera.focal[0] * local[:, 0] + camera.center[0] * w)
    y = samples * (camera.focal[1] * local[:, 1] + camera.center[1] * w)
    screen = np.stack([x, y, np.ones(len(points)), w], axis=1)
    raster = rasterise(screen_triangles(screen, triangles), width, height).triangle
    rows, columns = np.nonzero(raster >= 0)
    color = np.full((height, width, 3), 0.05, np.float32)
    for start in range(0, len(rows), 200_000):
        at = slice(start, start + 200_000)
        ids = raster[rows[at], columns[at]]
        weights = barycentrics(screen, triangles, ids, columns[at] + 0.5, rows[at] + 0.5)
        color[rows[at], columns[at]] = _shown(triangles[ids], weights, normals)
    small = color.reshape(camera.height, samples, camera.width, samples, 3).mean(axis=(1, 3))
    noisy = to_srgb(small) * 255 + np.random.default_rng(seed).normal(0.0, 1.0, small.shape)
    return np.clip(noisy + 0.5, 0, 255).astype(np.uint8)


def colors_at(points: FloatArray, places: FloatArray) -> FloatArray:
    """(m, 3) linear colours, as a face of ICT points (n, 3) shows them, where it is nearest to places (m, 3)."""
    triangles = solid_triangles()
    nearest = closest_places(places, points, triangles)
    corners = triangles[nearest.triangles]
    weights = points_to_barycentric(points[corners], nearest.places)
    return _shown(corners, weights, point_normals(points, triangles))


def _shown(corners: IntArray, weights: FloatArray, normals: FloatArray) -> FloatArray:
    """(m, 3) linear colours at places by the corners (m, 3) of their triangles and shares (m, 3) of these."""
    rest = np.einsum("mk,mkc->mc", weights, ict().neutral[corners])
    normal = np.einsum("mk,mkc->mc", weights, normals[corners])
    makeup = np.einsum("mk,mk->m", weights, _makeup()[corners])
    return paint(rest, makeup, corners[:, 0]) * _light(normal)[:, None]


def _light(normal: FloatArray) -> FloatArray:
    unit = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    light = np.full(len(unit), _AMBIENT)
    for direction, strength in _LAMPS:
        towards = np.array(direction) / np.linalg.norm(direction)
        light += strength * np.maximum(unit @ towards + 0.2, 0.0) / 1.2
    return light


def paint(rest: FloatArray, makeup: FloatArray, corner: IntArray) -> FloatArray:
    """(m, 3) linear colour at places (m, 3) of the neutral, in triangles that start at the points `corner` (m,)."""
    tone = np.zeros(len(rest))
    for number, (cell, contrast) in enumerate(_OCTAVES):
        where = (rest / cell + 13.7 * number).T
        tone += contrast * map_coordinates(_noise()[number], where, order=1, mode="grid-wrap")
    base = np.array(_SKIN) * (1.0 + makeup[:, None] * np.array([-0.35, -0.55, -0.45]))
    for first, last in _EYEBALLS:
        eye = (corner >= first) & (corner < last)
        ahead = rest[eye] - ict().neutral[first:last].mean(axis=0)
        iris = ahead[:, 2] > 0.89 * np.linalg.norm(ahead, axis=1)
        base[eye] = np.where(iris[:, None], _IRIS, _SCLERA)
    return base * np.exp(tone)[:, None]


@functools.cache
def _makeup() -> FloatArray:
    """(n,) 0..1: how much of brow or lip is at a point."""
    landmarks = ict().neutral[ict().landmarks]
    lift = np.array([0.0, 2.0, 0.0])
    upper, lower = np.r_[landmarks[48:55], landmarks[60:65]], np.r_[landmarks[54:60], landmarks[64:68]]
    strips = ((landmarks[17:22] + lift, 4.5), (landmarks[22:27] + lift, 4.5), (upper, 3.5), (lower, 4.0))
    found = np.zeros(len(ict().neutral))
    for strip, width in strips:
        share = np.linspace(0, 1, 4)[:, None, None]
        dense = (strip[:-1] * (1 - share) + strip[1:] * share).reshape(-1, 3)
        gap, _ = cKDTree(dense).query(ict().neutral)
        found = np.maximum(found, 1.0 / (1.0 + np.exp((gap - width) / 0.6)))
    return np.where(ict().neutral[:, 2] > 40.0, found, 0.0)


@functools.cache
def _noise() -> FloatArray:
    """(octaves, cells, cells, cells) noise of variance 1 that wraps around."""
    rng = np.random.default_rng(3)
    blocks = []
    for _ in _OCTAVES:
        block = gaussian_filter(rng.standard_normal((_CELLS,) * 3).astype(np.float32), 0.7, mode="wrap")
        blocks.append(block / block.std())
    return np.array(blocks)


def take_photos(folder: Path, points: FloatArray, cameras: dict[str, PhotoCamera]) -> None:
    """Write a photo of every camera into `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, (name, camera) in enumerate(cameras.items()):
        Image.fromarray(photograph(points, camera, seed=number)).save(folder / name)


def noise_photos(folder: Path, count: int, size: tuple[int, int] = (96, 64), **settings: Any) -> list[Path]:
    """Photos that have nothing to do with each other."""
    folder.mkdir(exist_ok=True)
    files = []
    for number in range(count):
        pixels = np.random.default_rng(number).integers(0, 255, (size[1], size[0], 3), np.uint8)
        files.append(folder / f"{number}.png")
        Image.fromarray(pixels).save(files[-1], **settings)
    return files


def camera_at(eye: FloatArray, roll: float = 0.0, **changes: Any) -> PhotoCamera:
    """A camera at `eye` (3,) that looks at the origin."""
    ahead = -eye / np.linalg.norm(eye)
    right = np.cross(ahead, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    rotation = Rotation.from_rotvec([0.0, 0.0, roll]).as_matrix() @ np.stack([right, np.cross(ahead, right), ahead])
    known = {"width": 640, "height": 800, "focal": (1500.0, 1510.0), "center": (322.0, 396.0)}
    return PhotoCamera(**(known | changes), rotation=rotation, translation=-rotation @ eye)
