"""Tables with bars: slider values around their defaults, and expression weights."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from facepipe.parts import Slider
from facepipe.pictures.overlay import INK
from facepipe.pictures.typesetting import BODY, MUTED, SMALL, Color, below, beside, block, heading, text_width, write

if TYPE_CHECKING:
    from PIL.Image import Image

ABOVE: Color = (32, 120, 170)  # bars from the default up
UNDER: Color = (222, 126, 48)  # and down
TRACK: Color = (231, 233, 237)
ACTIVE = 0.02  # share of the range (of 1 for a weight) beyond which a control counts as moved
MOST_SLIDERS, MOST_SHAPES = 60, 24  # rows; what has moved least is counted instead
ROW, BAR = 38, 16  # pixels
ONE_COLUMN = 16  # rows up to which sliders stand in one column
TORN = 2.5  # rows of height that are given for a group that stays together
GAP = 56  # between the columns

Row = Slider | str  # a slider, or the heading of a group


def slider_table(sliders: Sequence[Slider], values: Mapping[str, float], width: int) -> Image:
    """The sliders that have moved, by group; the others are counted.

    A bar leads from the default to the value on a track that stands for the slider's range.

    :param values: of the sliders that were free, in their own range
    """
    free = [slider for slider in sliders if slider.name in values]
    moved = {slider.name: _moved(slider, values[slider.name]) for slider in free}
    active = [slider for slider in free if moved[slider.name] > ACTIVE]
    groups = list(dict.fromkeys(slider.group for slider in sliders))
    shown = _most(active, moved, groups)
    note = f"{len(active)} of {len(free)} moved from the default" if free else "none fitted"
    parts = [heading(width, "Sliders", note)]
    if shown:
        columns = _columns(shown)
        each = (width - GAP * (len(columns) - 1)) // len(columns)
        names = _name_width([slider.name for slider in shown], each, 0.5 if len(columns) == 1 else 0.4)
        parts.append(beside([_column(rows, values, each, names) for rows in columns], GAP))
    notes = {
        "more moved less than these": len(active) - len(shown),
        f"within {ACTIVE:.0%} of the range from their default": len(free) - len(active),
        "not fitted": len(sliders) - len(free),
    }
    return below([*parts, _foot(width, notes)], 8)


def shape_table(weights: Sequence[Mapping[str, float]], titles: Sequence[str], width: int) -> Image:
    """Expression weights, the largest first: one row a shape, one bar a photo (`titles` name them)."""
    names = sorted({name for each in weights for name in each})
    largest = {name: max(abs(each.get(name, 0.0)) for each in weights) for name in names}
    active = sorted((name for name in names if largest[name] > ACTIVE), key=lambda name: -largest[name])
    shown = active[:MOST_SHAPES]
    parts = [heading(width, "Expression", f"{len(active)} of {len(names)} shapes in use" if names else "none fitted")]
    if shown:
        parts.append(_shape_rows(shown, weights, titles, width))
    notes = {"more in use": len(active) - len(shown), f"at {ACTIVE:g} or less": len(names) - len(active)}
    return below([*parts, _foot(width, notes)], 8)


def _most(active: Sequence[Slider], moved: Mapping[str, float], groups: Sequence[str]) -> list[Slider]:
    """Those that have moved most, group by group; groups and sliders in the face's order."""
    kept = {slider.name for slider in sorted(active, key=lambda slider: -moved[slider.name])[:MOST_SLIDERS]}
    return sorted((slider for slider in active if slider.name in kept), key=lambda slider: groups.index(slider.group))


def _moved(slider: Slider, value: float) -> float:
    """Distance from the default as a share of the range."""
    reach = slider.maximum - slider.minimum
    return abs(value - slider.default) / reach if reach > 0 else 0.0


def _columns(sliders: Sequence[Slider]) -> list[list[Row]]:
    """Headings and sliders in one column or two of about the same length, no group torn without need."""
    if len(sliders) <= ONE_COLUMN:
        return [list(_with_headings(sliders))]

    def cost(cut: int) -> float:
        torn = sliders[cut - 1].group == sliders[cut].group
        return max(len(half) for half in _cut(sliders, cut)) + (TORN if torn else 0.0)

    return _cut(sliders, min(range(1, len(sliders)), key=cost))


def _cut(sliders: Sequence[Slider], at: int) -> list[list[Row]]:
    return [list(_with_headings(half)) for half in (sliders[:at], sliders[at:])]


def _with_headings(sliders: Sequence[Slider]) -> Iterator[Row]:
    group = None
    for slider in sliders:
        if slider.group != group:
            group = slider.group
            yield group or "other"
        yield slider


def _column(rows: Sequence[Row], values: Mapping[str, float], width: int, names: float) -> Image:
    image = block(width, ROW * len(rows))
    numbers = text_width("-0.00") + BODY
    left, right = round(names + BODY * 0.8), round(width - numbers)
    for number, row in enumerate(rows):
        middle = ROW * number + ROW / 2
        if isinstance(row, str):
            write(image, (0, middle + 4), row, size=SMALL, color=MUTED, anchor="lm", room=width)
            continue
        value = values[row.name]
        write(image, (0, middle), row.name, anchor="lm", room=names)
        write(image, (width, middle), f"{value:.2f}", anchor="rm", room=numbers)
        draw_bar(image, (left, right), middle, (row.minimum, row.maximum), (row.default, value))
    return image


def _shape_rows(
    shown: Sequence[str], weights: Sequence[Mapping[str, float]], titles: Sequence[str], width: int
) -> Image:
    several = len(weights) > 1
    top, size = (ROW, SMALL) if several else (0, BODY)
    image = block(width, ROW * len(shown) + top)
    names = _name_width(shown, width, 0.3)
    for row, name in enumerate(shown):
        write(image, (0, top + ROW * (row + 0.5)), name, anchor="lm", room=names)
    values = [each[name] for each in weights for name in shown if name in each]
    limits = min([0.0, *values]), max([1.0, *values])
    numbers = text_width("-0.00", size) + BODY * 0.5
    cell = (width - names) / len(weights)
    for column, (each, title) in enumerate(zip(weights, titles, strict=True)):
        left, right = round(names + cell * column + BODY * 0.8), round(names + cell * (column + 1))
        if several:
            write(image, (left, ROW / 2), title, size=SMALL, color=MUTED, anchor="lm", room=right - left)
        for row, name in enumerate(shown):
            if name not in each:
                continue
            middle, color = top + ROW * (row + 0.5), INK if abs(each[name]) > ACTIVE else MUTED
            write(image, (right, middle), f"{each[name]:.2f}", size=size, color=color, anchor="rm", room=numbers)
            draw_bar(image, (left, round(right - numbers)), middle, limits, (0.0, each[name]))
    return image


def draw_bar(
    image: Image, span: tuple[int, int], middle: float, limits: tuple[float, float], values: tuple[float, float]
) -> None:
    """A track from the least to the largest value, a bar from the default to the value, and a tick at the default."""
    from PIL import ImageDraw

    (left, right), (low, high), (default, value) = span, limits, values
    top, bottom = round(middle - BAR / 2), round(middle + BAR / 2)

    def place(amount: float) -> int:
        share = (amount - low) / (high - low) if high > low else 0.0
        return round(left + min(max(share, 0.0), 1.0) * (right - left))

    pen = ImageDraw.Draw(image)
    pen.rectangle((left, top, right - 1, bottom - 1), fill=TRACK)
    start, end = sorted((place(default), place(value)))
    if end > start:
        pen.rectangle((start, top, end - 1, bottom - 1), fill=ABOVE if value > default else UNDER)
    tick = min(max(place(default), left + 1), right - 1)
    pen.rectangle((tick - 1, top - 4, tick, bottom + 3), fill=MUTED)


def _name_width(names: Sequence[str], width: float, share: float) -> float:
    """Room for the longest name, within a share of the width."""
    return min(max(text_width(name) for name in names) + 2, width * share)


def _foot(width: int, counts: Mapping[str, int]) -> Image:
    """How many controls are not in the table, and why."""
    notes = [f"{count} {why}" for why, count in counts.items() if count]
    image = block(width, SMALL * 1.5 * len(notes) + 6)
    for number, note in enumerate(notes):
        write(image, (0, SMALL * (1.5 * number + 1.1)), note, size=SMALL, color=MUTED, room=width)
    return image
