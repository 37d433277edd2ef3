"""Quick pictures of one surface for networks to look at: one lamp, no shadows, and the depth of every pixel."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray
from facepipe.geometry.coarse_surface import Look
from facepipe.geometry.colors import to_srgb
from facepipe.geometry.pinhole import Pinhole
from facepipe.pictures.camera import Camera
from facepipe.pictures.rasterise import barycentrics, rasterise, screen_triangles

_CLAY = (0.50, 0.40, 0.345)  # linear; of surfaces without colours
_BEHIND = 0.5  # linear grey
_LAMP = np.array([0.0, 0.447, 0.894])  # camera axes, unit length
_INSIDE = -0.15  # of a normal towards the viewer: below, the surface is seen from inside
_FLAT = 0.05  # brightness there
_SAMPLES = 2  # a pixel and direction


def draw_surface(look: Look, view: Pinhole) -> tuple[FloatArray, FloatArray]:
    """(size, size, 3) sRGB picture in 0..1, and (size, size) depth along the view, infinite where nothing is.

    The inner side is plain and dark, since the hollow back of a face would look like a face.
    Colours, which may hold light of their own, are shaded less than clay.
    """
    camera = Camera(axes=view.axes, eye=view.eye, focal=view.focal, center=(view.size / 2, view.size / 2))
    fine = camera.scaled(_SAMPLES)
    side = view.size * _SAMPLES
    screen = fine.project(look.points)
    raster = rasterise(screen_triangles(screen, look.triangles), side, side)
    row, column = np.nonzero(raster.key)
    ids = raster.triangle[row, column]
    weights = barycentrics(screen, look.triangles, ids, column + 0.5, row + 0.5)
    corners = look.triangles[ids]
    pixels = np.full((side, side, 3), _BEHIND)
    pixels[row, column] = _lit(look, fine.axes, weights, corners)
    image = to_srgb(pixels.reshape(view.size, _SAMPLES, view.size, _SAMPLES, 3).mean(axis=(1, 3)))
    depth = np.full((side, side), np.inf)
    depth[row, column] = 1.0 / raster.nearness[row, column]
    return image, depth.reshape(view.size, _SAMPLES, view.size, _SAMPLES).min(axis=(1, 3))


def _lit(look: Look, axes: FloatArray, weights: FloatArray, corners: npt.NDArray[np.integer]) -> FloatArray:
    """(m, 3) linear colours."""
    normals = np.einsum("mk,mkc->mc", weights, (look.normals @ axes.T)[corners])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    shade = 0.25 + 0.15 * normals[:, 1] + 0.75 * np.maximum(normals @ _LAMP, 0.0)
    inside = normals[:, 2] < _INSIDE
    if look.colors is None:
        shade[inside] = _FLAT
        return np.asarray(shade[:, None] * np.array(_CLAY))
    colors = np.einsum("mk,mkc->mc", weights, look.colors[corners]) * (0.5 + 0.5 * shade[:, None])
    colors[inside] = _FLAT * look.colors.mean(axis=0)
    return np.asarray(colors)
