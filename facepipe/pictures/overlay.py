"""What is written over a picture and below several: the colour bar, and the captions of contact sheets."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from facepipe.pictures.heatmap import HeatMap, colors, ticks

if TYPE_CHECKING:
    from PIL.Image import Image
    from PIL.ImageFont import FreeTypeFont, ImageFont

PAPER = (250, 250, 251)
INK = (38, 40, 46)


def contact_sheet(images: Sequence[tuple[str, Image]], columns: int) -> Image:
    """The pictures (one at least) row by row, `columns` to a row, captions below; cells as large as the largest."""
    from PIL import Image as Images
    from PIL import ImageDraw

    columns = min(columns, len(images))
    width, height = max(image.width for _, image in images), max(image.height for _, image in images)
    gap, letters = max(2, width // 40), max(9.0, width / 18)
    strip = round(letters * 1.7)
    rows = -(-len(images) // columns)
    sheet = Images.new("RGB", (columns * (width + gap) + gap, rows * (height + strip + gap) + gap), PAPER)
    pen = ImageDraw.Draw(sheet)
    for number, (caption, image) in enumerate(images):
        row, column = divmod(number, columns)
        left, top = gap + column * (width + gap), gap + row * (height + strip + gap)
        sheet.paste(image.convert("RGB"), (left + (width - image.width) // 2, top + (height - image.height) // 2))
        middle = left + width / 2, top + height + strip / 2
        pen.text(middle, caption, fill=INK, font=fitting_font(caption, letters, width), anchor="mm")
    return sheet


def font(pixels: float) -> FreeTypeFont | ImageFont:
    """Pillow's own scalable font."""
    from PIL import ImageFont

    return ImageFont.load_default(size=max(8.0, pixels))


def fitting_font(text: str, pixels: float, room: float) -> FreeTypeFont | ImageFont:
    """The font at `pixels`, or as much smaller (down to 8) as `text` needs to be no wider than `room`."""
    width = font(pixels).getlength(text)
    return font(pixels if width <= room else pixels * room / width)


def text_size(size: int) -> float:
    """Height of the letters in a picture of `size` pixels."""
    return max(9.0, size / 42)


def bar_width(size: int) -> int:
    """Pixels at the right that the colour bar takes."""
    return round(text_size(size) * 5.2)


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
        label_font = fitting_font(heatmap.label, letters, bottom - top)
        _upright(image, heatmap.label, left - letters * 0.5, (top + bottom) / 2, label_font)


def _upright(image: Image, text: str, right: float, middle: float, chosen: FreeTypeFont | ImageFont) -> None:
    """Text that reads upwards, its foot at the column `right`."""
    from PIL import Image as Images
    from PIL import ImageDraw

    x0, y0, x1, y1 = chosen.getbbox(text)
    mask = Images.new("L", (int(x1 - x0) + 2, int(y1 - y0) + 2), 0)
    ImageDraw.Draw(mask).text((1 - x0, 1 - y0), text, fill=255, font=chosen)
    turned = mask.transpose(Images.Transpose.ROTATE_90)
    place = round(right - turned.width), round(middle - turned.height / 2)
    image.paste(Images.new("RGB", turned.size, INK), place, turned)
