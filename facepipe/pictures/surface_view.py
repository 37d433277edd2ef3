"""Quick pictures of one surface, for networks to look at, and with landmarks for people: one lamp, no shadows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.geometry.coarse_surface import Look
from facepipe.geometry.colors import to_srgb
from facepipe.geometry.pinhole import Pinhole
from facepipe.geometry.rasterise import barycentrics, rasterise, screen_triangles
from facepipe.pictures.camera import Camera
from facepipe.pictures.overlay import DOT, INK, font

if TYPE_CHECKING:
    from PIL.Image import Image

_CLAY = (0.50, 0.40, 0.345)  # linear; of surfaces without colours
_BEHIND = 0.5  # linear grey
_LAMP = np.array([0.0, 0.447, 0.894])  # camera axes, unit length
_INSIDE = -0.15  # of a normal towards the viewer: below, the surface is seen from inside
_FLAT = 0.05  # brightness there
_SAMPLES = 2  # a pixel and direction
_FINE = 2  # pixels drawn for one of the sheet, so that dots have smooth edges
_HIDDEN = (240, 170, 170)
_SLACK = 0.02  # of the depth: a landmark this far behind the surface still shows


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
    normals = np.einsum("mk,mkc->mc", weights, (look.normals @ fine.axes.T)[corners])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    shade = 0.25 + 0.15 * normals[:, 1] + 0.75 * np.maximum(normals @ _LAMP, 0.0)
    inside = normals[:, 2] < _INSIDE
    if look.colors is None:
        shade[inside] = _FLAT
        colors = shade[:, None] * np.array(_CLAY)
    else:
        colors = np.einsum("mk,mkc->mc", weights, look.colors[corners]) * (0.5 + 0.5 * shade[:, None])
        colors[inside] = _FLAT * look.colors.mean(axis=0)
    pixels = np.full((side, side, 3), _BEHIND)
    pixels[row, column] = colors
    image = to_srgb(pixels.reshape(view.size, _SAMPLES, view.size, _SAMPLES, 3).mean(axis=(1, 3)))
    depth = np.full((side, side), np.inf)
    depth[row, column] = 1.0 / raster.nearness[row, column]
    return image, depth.reshape(view.size, _SAMPLES, view.size, _SAMPLES).min(axis=(1, 3))


def scan_sheet(look: Look, views: Sequence[Pinhole], landmarks: FloatArray) -> Image:
    """Pictures side by side, of the views' size, with numbered dots; those behind the surface are pale.

    :param landmarks: (l, 3), rows of NaN are left out
    """
    from PIL import Image, ImageDraw

    pictures = []
    for view in views:
        fine = Pinhole(axes=view.axes, eye=view.eye, focal=view.focal * _FINE, size=view.size * _FINE)
        pixels, depth = draw_surface(look, fine)
        image = Image.fromarray((pixels * 255 + 0.5).astype(np.uint8))
        pen, letters, radius = ImageDraw.Draw(image), font(fine.size / 60), fine.size / 220
        for number, (place, far) in enumerate(zip(*fine.project(landmarks), strict=True)):
            if not np.isfinite(place).all() or not ((place >= 0) & (place < fine.size)).all():
                continue
            x, y = place.tolist()
            hidden = far > depth[int(y), int(x)] * (1 + _SLACK)
            box = (x - radius, y - radius, x + radius, y + radius)
            pen.ellipse(box, fill=_HIDDEN if hidden else DOT, outline=(255, 255, 255), width=_FINE)
            if not hidden:
                pen.text((x + 1.5 * radius, y), str(number), fill=INK, font=letters, anchor="lm")
        pictures.append(np.asarray(image.reduce(_FINE)))
    return Image.fromarray(np.hstack(pictures))
