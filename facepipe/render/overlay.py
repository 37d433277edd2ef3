"""What is written over a picture: colour bar, landmark dots, title."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from facepipe.errors import InputError
from facepipe.parts import FaceParts
from facepipe.render.camera import Camera
from facepipe.render.heatmap import HeatMap, colors, ticks
from facepipe.render.rasterise import rasterise, screen_triangles
from facepipe.render.scene import Scene

if TYPE_CHECKING:
    from PIL.Image import Image
    from PIL.ImageFont import FreeTypeFont, ImageFont

FloatArray = npt.NDArray[np.floating]
IntArray = npt.NDArray[np.integer]

INK = (38, 40, 46)
DOT = (226, 40, 52)
HIDDEN = 0.35  # opacity of landmarks behind the surface


def font(pixels: float) -> FreeTypeFont | ImageFont:
    """Pillow's own scalable font."""
    from PIL import ImageFont

    return ImageFont.load_default(size=max(8.0, pixels))


def text_size(size: int) -> float:
    """Height of the letters in a picture of `size` pixels."""
    return max(9.0, size / 42)


def bar_width(size: int) -> int:
    """Pixels at the right that the colour bar takes."""
    return round(text_size(size) * 5.2)


def title_height(size: int) -> int:
    """Pixels at the top that the title takes."""
    return round(text_size(size) * 2.2)


def title(image: Image, text: str) -> None:
    """Write `text` at the top, in the middle."""
    from PIL import ImageDraw

    size = image.width
    ImageDraw.Draw(image).text(
        (size / 2, title_height(size) * 0.62), text, fill=INK, font=font(text_size(size) * 1.2), anchor="mm"
    )


def color_bar(image: Image, heatmap: HeatMap) -> None:
    """Draw the colours of a heat map with ticks at the right side; its label runs along the bar."""
    from PIL import Image as Images
    from PIL import ImageDraw

    size, letters = image.width, text_size(image.width)
    left, right = round(size - letters * 4.6), round(size - letters * 3.6)
    top, bottom = round(size * 0.14), round(size * 0.86)
    low, high = heatmap.limits
    shares = 1 - (np.arange(bottom - top) + 0.5) / (bottom - top)
    column = (colors(shares) * 255 + 0.5).astype(np.uint8)
    image.paste(Images.fromarray(np.repeat(column[:, None], right - left, axis=1)), (left, top))
    pen, line = ImageDraw.Draw(image), max(1, round(letters / 14))
    pen.rectangle((left - line, top - line, right + line - 1, bottom + line - 1), outline=INK, width=line)
    for value, text in ticks(low, high):
        y = bottom - (value - low) / (high - low) * (bottom - top)
        pen.line((right, y, right + letters * 0.35, y), fill=INK, width=line)
        pen.text((right + letters * 0.6, y), text, fill=INK, font=font(letters), anchor="lm")
    pen.text(((left + right) / 2, top - letters * 0.9), heatmap.unit, fill=INK, font=font(letters), anchor="mm")
    if heatmap.label:
        _upright(image, heatmap.label, left - letters * 0.5, (top + bottom) / 2, letters)


def _upright(image: Image, text: str, right: float, middle: float, letters: float) -> None:
    """Text that reads upwards, its foot at the column `right`."""
    from PIL import Image as Images
    from PIL import ImageDraw

    chosen = font(letters)
    x0, y0, x1, y1 = chosen.getbbox(text)
    mask = Images.new("L", (int(x1 - x0) + 2, int(y1 - y0) + 2), 0)
    ImageDraw.Draw(mask).text((1 - x0, 1 - y0), text, fill=255, font=chosen)
    turned = mask.transpose(Images.Transpose.ROTATE_90)
    place = round(right - turned.width), round(middle - turned.height / 2)
    image.paste(Images.new("RGB", turned.size, INK), place, turned)


def landmarks(
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
    pen, letters = ImageDraw.Draw(image), font(max(8.0, image.width / 72))
    for (x, y), number, clear in zip(where, numbers, seen, strict=True):
        if clear and numbered:
            pen.text(
                (x + radius * 1.6, y - radius * 1.2), str(number), fill=INK, font=letters, anchor="lm",
                stroke_width=max(1, round(image.width / 700)), stroke_fill=(255, 255, 255),
            )  # fmt: skip


def landmark_points(parts: FaceParts, scheme: str) -> tuple[IntArray, IntArray]:
    """Points (l,) of all meshes' landmarks of a scheme, and their numbers within it.

    :raises InputError: no mesh has the scheme
    """
    points, numbers, start = [], [], 0
    for mesh in parts.meshes:
        if scheme in mesh.landmarks:
            indices = np.asarray(mesh.landmarks[scheme].indices, dtype=np.int64)
            if len(indices) and (indices.min() < 0 or indices.max() >= len(mesh.points)):
                raise InputError(
                    f"{mesh.name} -> landmarks {scheme}", f"an index is outside 0 to {len(mesh.points) - 1}"
                )
            points.append(indices + start)
            numbers.append(np.arange(len(indices)))
        start += len(mesh.points)
    if not points:
        known = sorted({name for mesh in parts.meshes for name in mesh.landmarks})
        raise InputError(f"{parts.name} -> landmarks", f"no scheme {scheme!r}, expected one of {known}")
    return np.concatenate(points), np.concatenate(numbers)


def _visible(scene: Scene, screen: FloatArray, points: IntArray, size: tuple[int, int]) -> npt.NDArray[np.bool_]:
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
