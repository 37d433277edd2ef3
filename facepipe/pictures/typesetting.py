"""Pages of text, shapes with smooth edges and blocks that stand below or beside each other."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.pictures.overlay import INK, font
from facepipe.pictures.sheet import PAPER

if TYPE_CHECKING:
    from PIL.Image import Image
    from PIL.ImageFont import FreeTypeFont, ImageFont

Color = tuple[int, int, int]

BODY, SMALL, HEADING, TITLE = 25.0, 21.0, 32.0, 56.0  # heights of letters, pixels
MUTED: Color = (118, 122, 132)  # what explains
RULE: Color = (219, 221, 226)  # lines that part
FINE = 4  # shapes are drawn this many times as large, in both directions
SQUEEZE = 0.84  # letters shrink to this share before text is cut


def block(width: int, height: float) -> Image:
    """An empty piece of paper."""
    from PIL import Image

    return Image.new("RGB", (width, max(1, round(height))), PAPER)


def below(blocks: Sequence[Image], gap: int) -> Image:
    """The blocks on top of each other, left aligned."""
    sheet = block(max(each.width for each in blocks), sum(each.height for each in blocks) + gap * (len(blocks) - 1))
    top = 0
    for each in blocks:
        sheet.paste(each, (0, top))
        top += each.height + gap
    return sheet


def beside(blocks: Sequence[Image], gap: int) -> Image:
    """The blocks from left to right, top aligned."""
    sheet = block(sum(each.width for each in blocks) + gap * (len(blocks) - 1), max(each.height for each in blocks))
    left = 0
    for each in blocks:
        sheet.paste(each, (left, 0))
        left += each.width + gap
    return sheet


def write(
    image: Image,
    at: tuple[float, float],
    text: str,
    *,
    size: float = BODY,
    color: Color = INK,
    anchor: str = "ls",
    room: float | None = None,
) -> float:
    """Write one line; in less than its `room`, letters shrink a little, then its middle is left out.

    Returns the width of what is written, pixels.
    """
    from PIL import ImageDraw

    if room is not None:
        text, size = fitted(text, size, room)
    ImageDraw.Draw(image).text(at, text, fill=color, font=_letters(size), anchor=anchor)
    return text_width(text, size)


def fitted(text: str, size: float, room: float) -> tuple[str, float]:
    """A text and a size of letters that need no more than `room` pixels.

    Names are told apart by their beginnings and ends, so what is left out of a long one is its middle.
    """
    least = size * SQUEEZE
    for each in np.arange(size, least, -1.0):
        if text_width(text, float(each)) <= room:
            return text, float(each)
    shown = text
    for kept in range(len(text) - 1, 0, -1):
        if text_width(shown, least) <= room:
            break
        shown = f"{text[: (kept + 1) // 2]}...{text[len(text) - kept // 2 :]}"
    return (shown if text_width(shown, least) <= room else ""), least


def text_width(text: str, size: float = BODY) -> float:
    """Pixels that a line takes."""
    return float(_letters(size).getlength(text))


@cache
def _letters(size: float) -> FreeTypeFont | ImageFont:
    """The font, read once a size: a page asks for it some thousand times."""
    return font(size)


def heading(width: int, text: str, note: str = "") -> Image:
    """A line with a rule below it; the note stands at the right."""
    from PIL import ImageDraw

    image = block(width, HEADING * 1.9)
    taken = write(image, (0, HEADING * 1.05), text, size=HEADING, room=width)
    room = width - taken - BODY
    if note and room > BODY * 4:
        write(image, (width, HEADING * 1.05), note, size=SMALL, color=MUTED, anchor="rs", room=room)
    ImageDraw.Draw(image).rectangle((0, round(HEADING * 1.42), width - 1, round(HEADING * 1.42) + 1), fill=RULE)
    return image


class Shapes:
    """Lines, discs and rings gathered on a fine grid, then painted in one colour with smooth edges.

    Coordinates are pixels of the picture, (0, 0) its top left corner.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        from PIL import Image, ImageDraw

        self.mask = Image.new("L", (size[0] * FINE, size[1] * FINE), 0)
        self.pen = ImageDraw.Draw(self.mask)

    def line(self, points: FloatArray, width: float) -> None:
        """A line with round corners and ends through points (m, 2); one point gives a disc."""
        fine = np.asarray(points, dtype=np.float64) * FINE - 0.5
        if len(fine) > 1:
            self.pen.line([tuple(each) for each in fine.tolist()], fill=255, width=round(width * FINE), joint="curve")
        for end in (points[0], points[-1]):
            self.disc((float(end[0]), float(end[1])), width / 2)

    def disc(self, center: tuple[float, float], radius: float, fill: int = 255) -> None:
        """A disc; with `fill` 0 it takes away what is there."""
        x, y, reach = center[0] * FINE - 0.5, center[1] * FINE - 0.5, radius * FINE
        self.pen.ellipse((x - reach, y - reach, x + reach, y + reach), fill=fill)

    def ring(self, center: tuple[float, float], radius: float, width: float) -> None:
        """A circle whose line has its middle at `radius`; what is inside stays as it is."""
        x, y, reach = center[0] * FINE - 0.5, center[1] * FINE - 0.5, (radius + width / 2) * FINE
        self.pen.ellipse((x - reach, y - reach, x + reach, y + reach), outline=255, width=round(width * FINE))

    def paint(self, image: Image, color: Color, opacity: float = 1.0) -> None:
        """Put the shapes onto a picture of the size given at first."""
        cover = self.mask.reduce(FINE).point([round(level * opacity) for level in range(256)])
        image.paste(color, (0, 0), cover)
