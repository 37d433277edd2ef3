"""Contact sheets: many pictures on one, each with a caption."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from facepipe.core.errors import InputError
from facepipe.pictures.overlay import INK, fitting_font

if TYPE_CHECKING:
    from PIL.Image import Image

PAPER = (250, 250, 251)


def contact_sheet(images: Sequence[tuple[str, Image]], columns: int) -> Image:
    """The pictures row by row, `columns` to a row, captions below them; cells as large as the largest picture.

    :raises InputError: no pictures, or fewer than one column
    """
    from PIL import Image as Images
    from PIL import ImageDraw

    if not images or columns < 1:
        raise InputError("contact sheet", f"{len(images)} pictures in {columns} columns, expected one or more of each")
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
        pen.text(
            (left + width / 2, top + height + strip / 2),
            caption,
            fill=INK,
            font=fitting_font(caption, letters, width),
            anchor="mm",
        )
    return sheet
