"""Landmarks drawn over a picture: numbered dots, faint where the surface hides them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.core.names import unknown
from facepipe.geometry.rasterise import rasterise, screen_triangles
from facepipe.parts import FaceParts
from facepipe.pictures.camera import Camera
from facepipe.pictures.overlay import INK, font
from facepipe.pictures.scene import Scene

if TYPE_CHECKING:
    from PIL.Image import Image


DOT = (226, 40, 52)
HIDDEN = 0.35  # opacity of landmarks behind the surface


def draw_landmarks(
    image: Image, parts: FaceParts, scene: Scene, camera: Camera, scheme: str, *, numbered: bool = True
) -> None:
    """Dots with numbers at the landmarks of a scheme; those behind the surface are faint.

    :raises InputError: no mesh has the scheme
    """
    from PIL import Image as Images
    from PIL import ImageDraw

    points, numbers = landmark_points(parts, scheme)
    screen = camera.project(scene.points)
    where = screen[points, :2] / screen[points, 3:]
    seen = _visible(scene, screen, points, image.size)
    radius = max(1.6, image.width / 260)
    pixels = np.asarray(image, dtype=np.float64).copy()
    for (x, y), clear in zip(where, seen, strict=True):
        _disc(pixels, x, y, radius + max(0.7, radius * 0.3), (255, 255, 255), 0.9 if clear else HIDDEN / 2)
        _disc(pixels, x, y, radius, DOT, 1.0 if clear else HIDDEN)
    image.paste(Images.fromarray((pixels + 0.5).astype(np.uint8)))
    if not numbered:
        return
    pen, letters = ImageDraw.Draw(image), font(max(8.0, image.width / 72))
    shown = np.flatnonzero(seen)
    texts = [str(numbers[each]) for each in shown]
    widths = np.array([letters.getlength(text) for text in texts])
    for text, (x, y) in zip(texts, _label_centers(where, where[shown], widths, radius), strict=True):
        pen.text(
            (x, y), text, fill=INK, font=letters, anchor="mm",
            stroke_width=max(1, round(image.width / 700)), stroke_fill=(255, 255, 255),
        )  # fmt: skip


def _label_centers(dots: FloatArray, places: FloatArray, widths: FloatArray, radius: float) -> FloatArray:
    """(m, 2) where to centre the labels of the dots at `places` (m, 2): on the side with the most room around it."""
    turns = np.arange(12) * np.pi / 6
    taken = [*dots]
    centers = np.zeros((len(places), 2))
    for number, (place, width) in enumerate(zip(places, widths, strict=True)):
        reach = radius * 2.2 + np.stack([width / 2 * np.abs(np.cos(turns)), radius * np.abs(np.sin(turns))], axis=1)
        choices = place + reach * np.stack([np.cos(turns), -np.sin(turns)], axis=1)
        apart = np.linalg.norm(choices[:, None] - np.array(taken)[None], axis=2)
        # Crowding falls off steeply; the first, to the right, wins where all sides are free.
        crowding = (np.maximum(apart, 1.0) ** -3).sum(axis=1)
        centers[number] = choices[np.argmin(np.round(crowding * radius**3, 3))]
        taken.append(centers[number])
    return centers


def landmark_points(parts: FaceParts, scheme: str) -> tuple[IntArray, IntArray]:
    """Points (l,) of all meshes' landmarks of a scheme, and their numbers within it.

    :raises InputError: no mesh has the scheme
    """
    points, numbers, start = [], [], 0
    for mesh in parts.meshes:
        if scheme in mesh.landmarks:
            indices = np.asarray(mesh.landmarks[scheme].indices, dtype=np.int64)
            points.append(indices + start)
            numbers.append(np.arange(len(indices)))
        start += len(mesh.points)
    if not points:
        known = sorted({name for mesh in parts.meshes for name in mesh.landmarks})
        raise InputError(f"{parts.name} -> landmarks", unknown(scheme, known, "scheme"))
    return np.concatenate(points), np.concatenate(numbers)


def _visible(scene: Scene, screen: FloatArray, points: IntArray, size: tuple[int, int]) -> BoolArray:
    """(l,) points with nothing opaque clearly in front of them."""
    width, height = size
    solid = scene.triangles[~scene.see_through]
    nearness = rasterise(screen_triangles(screen, solid), width, height).nearness
    at = screen[points, :2] / screen[points, 3:]
    column = np.clip(np.floor(at[:, 0]), 0, width - 1).astype(np.int64)
    row = np.clip(np.floor(at[:, 1]), 0, height - 1).astype(np.int64)
    depth = screen[points, 3]
    slack = 0.02 * float(np.ptp(screen[np.unique(scene.triangles), 3])) if len(scene.triangles) else 0.0
    return np.asarray(nearness[row, column] * (depth - slack) <= 1.0)


def _disc(pixels: FloatArray, x: float, y: float, radius: float, color: tuple[int, int, int], opacity: float) -> None:
    """Blend a smooth-edged disc into (h, w, 3) pixels."""
    height, width = pixels.shape[:2]
    left, right = max(0, int(x - radius - 2)), min(width, int(x + radius + 3))
    top, bottom = max(0, int(y - radius - 2)), min(height, int(y + radius + 3))
    if right <= left or bottom <= top:
        return
    columns, rows = np.arange(left, right) + 0.5 - x, np.arange(top, bottom) + 0.5 - y
    cover = np.clip(radius + 0.5 - np.hypot(columns[None, :], rows[:, None]), 0, 1)[..., None] * opacity
    pixels[top:bottom, left:right] += (np.array(color) - pixels[top:bottom, left:right]) * cover
