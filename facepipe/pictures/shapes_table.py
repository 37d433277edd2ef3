"""How much scans told of each of a face's shapes: a table with bars."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from facepipe.pictures.overlay import INK
from facepipe.pictures.slider_table import ROW, draw_bar
from facepipe.pictures.typesetting import BODY, MUTED, SMALL, below, block, heading, text_width, write

if TYPE_CHECKING:
    from PIL.Image import Image

WIDTH = 1300  # pixels
COLUMNS = 4  # of shapes that no scan told
_BORDER = 28
_BARS = 260  # from 0 to 1
_OBSERVED, _GAIN, _CHANGE = 80, 190, 350  # from the end of the bars to where numbers end, pixels


@dataclass(frozen=True, kw_only=True)
class ShapeRow:
    """What scans told of one shape."""

    name: str
    observed: float  # 0..1, the rest being the template's
    gain: float  # motion along the template's, over the template's
    change_mm: float  # mean distance from the template's
    scans: tuple[str, ...]  # that show it
    unseen: bool = False  # told too little: it is the template's


def shapes_table(rows: Sequence[ShapeRow], title: str = "Shapes") -> Image:
    """One row a shape, what changed most first; those that no scan told follow in grey, names alone."""
    told = sorted((row for row in rows if not row.unseen), key=lambda row: -row.change_mm)
    unseen = [row for row in rows if row.unseen]
    width = WIDTH - 2 * _BORDER
    blocks = [heading(width, title, f"{len(told)} of {len(rows)} told by the scans")]
    if told:
        blocks.append(_told(told, width))
    if unseen:
        blocks += [block(width, SMALL * 0.4), _unseen(unseen, width)]
    page = below(blocks, 6)
    sheet = block(WIDTH, page.height + 2 * _BORDER)
    sheet.paste(page, (_BORDER, _BORDER))
    return sheet


def _told(rows: Sequence[ShapeRow], width: int) -> Image:
    image = block(width, ROW * (len(rows) + 1))
    names = min(max(text_width(row.name) for row in rows) + 2, width * 0.3)
    bar = round(names + BODY), round(names + BODY) + _BARS
    observed, gain, change = (bar[1] + column for column in (_OBSERVED, _GAIN, _CHANGE))
    scans = change + BODY * 1.6
    heads = ((bar[0], "told by scans, 0 to 1", "lm"), (gain, "gain", "rm"), (change, "change mm", "rm"))
    for x, text, anchor in (*heads, (scans, "scans that show it", "lm")):
        write(image, (x, ROW / 2), text, size=SMALL, color=MUTED, anchor=anchor)
    for number, row in enumerate(rows, start=1):
        middle = ROW * (number + 0.5)
        write(image, (0, middle), row.name, anchor="lm", room=names)
        draw_bar(image, bar, middle, (0.0, 1.0), (0.0, row.observed))
        for x, amount in ((observed, row.observed), (gain, row.gain), (change, row.change_mm)):
            write(image, (x, middle), f"{amount:.2f}", anchor="rm")
        write(image, (scans, middle), some_of(row.scans, width - scans), size=SMALL, anchor="lm", room=width - scans)
    return image


def _unseen(rows: Sequence[ShapeRow], width: int) -> Image:
    """Names in columns, grey."""
    lines = -(-len(rows) // COLUMNS)
    image = block(width, ROW * (lines + 1))
    write(image, (0, ROW / 2), "not told by the scans: as the template has them", size=SMALL, color=INK, anchor="lm")
    each = width / COLUMNS
    for number, row in enumerate(rows):
        column, line = divmod(number, lines)
        place = column * each, ROW * (line + 1.5)
        write(image, place, row.name, size=SMALL, color=MUTED, anchor="lm", room=each - BODY)
    return image


def some_of(names: Sequence[str], room: float) -> str:
    """As many names as there is room for, and how many more there are."""
    for kept in range(len(names), 0, -1):
        more = f" + {len(names) - kept}" if kept < len(names) else ""
        text = ", ".join(names[:kept]) + more
        if text_width(text, SMALL) <= room or kept == 1:
            return text
    return ""
