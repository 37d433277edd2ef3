"""The legend of a page: the colours of a heat map along a line, with numbers below them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from facepipe.pictures.heatmap import NO_VALUE, colors, ticks
from facepipe.pictures.overlay import INK
from facepipe.pictures.typesetting import BODY, MUTED, SMALL, block, text_width, write

if TYPE_CHECKING:
    from PIL.Image import Image

_BAR = 22  # pixels
_LONGEST = 640


def color_scale(width: int, limits: tuple[float, float], text: str, none: str = "", unit: str = "mm") -> Image:
    """A strip `width` pixels wide: the bar from the least to the largest value, what it says, and what grey stands for.

    :param none: what has no value, empty where all have one
    """
    from PIL import Image as Images
    from PIL import ImageDraw

    image = block(width, SMALL * 1.6 + _BAR + SMALL * 1.7)
    top, long = round(SMALL * 1.6), min(_LONGEST, width * 2 // 3)
    write(image, (0, SMALL * 1.05), text, size=SMALL, color=MUTED, room=width)
    low, high = limits
    shares = (np.arange(long) + 0.5) / long
    row = (colors(shares) * 255 + 0.5).astype(np.uint8)
    image.paste(Images.fromarray(np.repeat(row[None], _BAR, axis=0)), (0, top))
    pen = ImageDraw.Draw(image)
    marks = ticks(low, high)
    for number, (value, figure) in enumerate(marks):
        x = min((value - low) / (high - low) * long, long - 1)
        pen.line((x, top + _BAR, x, top + _BAR + 5), fill=INK, width=2)
        shown = f"{figure} {unit}" if number == len(marks) - 1 else figure
        place = max(0.0, x - text_width(figure, SMALL) / 2)
        write(image, (place, top + _BAR + SMALL * 1.25), shown, size=SMALL)
    if none:
        left = long + round(BODY * 2)
        grey = tuple(round(255 * level) for level in NO_VALUE)
        pen.rectangle((left, top, left + _BAR - 1, top + _BAR - 1), fill=grey)
        room = width - left - _BAR - BODY
        write(image, (left + _BAR + BODY * 0.5, top + _BAR / 2), none, size=SMALL, anchor="lm", room=room)
    return image
