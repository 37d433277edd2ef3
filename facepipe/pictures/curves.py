"""Curves of losses over the steps of a fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.pictures.heatmap import ticks
from facepipe.pictures.overlay import INK
from facepipe.pictures.typesetting import (
    BODY,
    MUTED,
    RULE,
    SMALL,
    Color,
    Shapes,
    below,
    block,
    heading,
    text_width,
    write,
)

if TYPE_CHECKING:
    from PIL.Image import Image


TOTAL = "total"
HEIGHT = 620  # pixels of the plot
COLORS: tuple[Color, ...] = (  # told apart by colour-blind readers too, in this order
    (0, 114, 178), (213, 94, 0), (0, 158, 115), (204, 121, 167), (86, 180, 233), (230, 159, 0), (120, 94, 240),
    (128, 128, 128), (150, 75, 40), (170, 190, 60),
)  # fmt: skip
LOGARITHMIC = 20.0  # the largest over the smallest loss from which a logarithmic axis is used
DECADES = 6.0  # a logarithmic axis shows at most these below the largest loss
LABEL = SMALL * 1.32  # distance of the names at the right


@dataclass(frozen=True, kw_only=True)
class Axes:
    """Where steps and losses are in a plot, in pixels."""

    box: tuple[float, float, float, float]  # left, top, right, bottom
    steps: int  # the last
    limits: tuple[float, float]  # losses at the bottom and the top
    logarithmic: bool

    def x(self, step: float) -> float:
        """Column of a step; a single step stands at the left."""
        left, _, right, _ = self.box
        return left + step / max(self.steps, 1) * (right - left)

    def y(self, losses: FloatArray) -> FloatArray:
        """Rows of losses (m,): NaN where there is none, or none above 0 on a logarithmic axis."""
        _, top, _, bottom = self.box
        known = np.isfinite(losses) & ((losses > 0) | (not self.logarithmic))
        low, high, at = *self.limits, np.where(known, losses, self.limits[1])
        if self.logarithmic:
            low, high, at = np.log10(low), np.log10(high), np.log10(at)
        share = np.clip((at - low) / (high - low), 0.0, 1.0)
        return np.where(known, bottom - share * (bottom - top), np.nan)

    @property
    def ticks(self) -> list[tuple[float, str]]:
        """Losses with their texts."""
        low, high = self.limits
        if not self.logarithmic:
            return ticks(low, high)
        powers = range(int(np.floor(np.log10(low) + 1e-9)), int(np.ceil(np.log10(high) - 1e-9)) + 1)
        factors = (1,) if np.log10(high / low) > 3 else (1, 2, 5)
        values = [factor * 10.0**power for power in powers for factor in factors]
        return [(value, f"{value:.3g}") for value in values if low * 0.999 <= value <= high * 1.001]


def loss_curves(
    history: Sequence[Mapping[str, float]],
    width: int,
    stages: Sequence[tuple[int, str]] = (),
    note: str = "weighted terms, by step",
) -> Image:
    """A curve for every term, the total the boldest; NaN and infinity leave gaps.

    :param history: by step, term -> weighted loss
    :param stages: steps at which a part of the fit began, and its name
    :param note: what is drawn
    """
    terms = _terms(history)
    if not terms:
        image = block(width, SMALL * 2)
        write(image, (0, SMALL * 1.3), "no steps were made", size=SMALL, color=MUTED, room=width)
        return below([heading(width, "Losses"), image], 8)
    axes = _axes(terms, len(history), width, bool(stages))
    image = block(width, HEIGHT)
    _grid(image, axes)
    _stages(image, axes, stages)
    for name in reversed(terms):
        _curve(image, axes, terms[name], _color(name, terms), 4.0 if name == TOTAL else 2.6)
    _names(image, axes, terms)
    note += ", logarithmic" if axes.logarithmic else ""
    return below([heading(width, "Losses", note), image], 8)


def _terms(history: Sequence[Mapping[str, float]]) -> dict[str, FloatArray]:
    """Term -> losses by step, the total first, then in the order of their appearance."""
    names = list(dict.fromkeys(name for each in history for name in each))
    names.sort(key=lambda name: name != TOTAL)
    found = {name: np.array([each.get(name, np.nan) for each in history], dtype=np.float64) for name in names}
    return {name: np.where(np.isfinite(losses), losses, np.nan) for name, losses in found.items()}


def _axes(terms: Mapping[str, FloatArray], count: int, width: int, staged: bool) -> Axes:
    known = np.concatenate([losses[np.isfinite(losses)] for losses in terms.values()])
    positive = known[known > 0]
    logarithmic = bool(len(positive) and not (known < 0).any() and positive.max() > LOGARITHMIC * positive.min())
    limits = _logarithmic_limits(positive) if logarithmic else _straight_limits(known)
    plain = Axes(box=(0, 0, 1, 1), steps=count - 1, limits=limits, logarithmic=logarithmic)
    left = max(text_width(text, SMALL) for _, text in plain.ticks) + 16
    right = width - min(max(text_width(text, SMALL) for text in _texts(terms).values()) + 52, width * 0.38)
    top = SMALL * (3.2 if staged else 0.8)
    return Axes(box=(left, top, right, HEIGHT - SMALL * 3.1), steps=count - 1, limits=limits, logarithmic=logarithmic)


def _logarithmic_limits(losses: FloatArray) -> tuple[float, float]:
    high = float(losses.max()) * 1.2
    low = max(float(losses.min()) / 1.2, high / 10**DECADES)
    return low, high


def _straight_limits(losses: FloatArray) -> tuple[float, float]:
    """From 0, or the least below it, to a little above the largest."""
    low = min(0.0, float(losses.min())) if len(losses) else 0.0
    high = max(0.0, float(losses.max())) if len(losses) else 1.0
    return (low, low + (high - low) * 1.05) if high > low else (0.0, 1.0)


def _grid(image: Image, axes: Axes) -> None:
    from PIL import ImageDraw

    pen = ImageDraw.Draw(image)
    left, _, right, bottom = (round(each) for each in axes.box)
    for value, text in axes.ticks:
        row = round(float(axes.y(np.array([value]))[0])) if value or not axes.logarithmic else bottom
        pen.line((left, row, right, row), fill=RULE, width=1)
        write(image, (left - 12, row), text, size=SMALL, color=MUTED, anchor="rm")
    pen.line((left, bottom, right, bottom), fill=MUTED, width=2)
    for step, text in _step_ticks(axes.steps):
        column = round(axes.x(step))
        pen.line((column, bottom, column, bottom + 8), fill=MUTED, width=2)
        write(image, (column, bottom + 14), text, size=SMALL, color=MUTED, anchor="ma")
    write(image, ((left + right) / 2, bottom + 14 + SMALL * 1.2), "step", size=SMALL, color=MUTED, anchor="ma")


def _step_ticks(last: int) -> list[tuple[float, str]]:
    """Whole steps only."""
    if last <= 0:
        return [(0.0, "0")]
    return [(step, text) for step, text in ticks(0, last) if float(step).is_integer() and "." not in text] or [
        (0.0, "0"),
        (float(last), str(last)),
    ]


def _stages(image: Image, axes: Axes, stages: Sequence[tuple[int, str]]) -> None:
    """Dashed lines where parts of the fit begin; names take turns on two lines, for the sake of short parts."""
    from PIL import ImageDraw

    pen = ImageDraw.Draw(image)
    _, top, right, bottom = axes.box
    columns = [axes.x(min(max(step, 0), max(axes.steps, 1))) for step, _ in stages]
    ends = [*columns[2:], right, right]
    for number, ((step, name), column, end) in enumerate(zip(stages, columns, ends, strict=False)):
        row = top - SMALL * (0.6 if number % 2 else 1.8)
        if step > 0:
            for dash in range(round(row - SMALL * 0.7), round(bottom), 14):
                pen.line((round(column), dash, round(column), min(dash + 7, round(bottom))), fill=MUTED, width=2)
        if end - column > BODY * 2:
            write(image, (column + 8, row), name, size=SMALL, color=MUTED, room=end - column - 14)


def _curve(image: Image, axes: Axes, losses: FloatArray, color: Color, width: float) -> None:
    rows = axes.y(losses)
    known = np.flatnonzero(np.isfinite(rows))
    shapes = Shapes(image.size)
    for run in np.split(known, np.flatnonzero(np.diff(known) > 1) + 1):
        if len(run) == 1:
            shapes.disc((axes.x(float(run[0])), float(rows[run[0]])), width * 1.2)
        elif len(run):
            shapes.line(np.stack([[axes.x(float(step)) for step in run], rows[run]], axis=1), width)
    shapes.paint(image, color)


def _names(image: Image, axes: Axes, terms: Mapping[str, FloatArray]) -> None:
    """The legend: names with their last losses at the height where the curves end, kept apart from each other."""
    right, texts = axes.box[2], _texts(terms)
    ends = {name: _end(axes, losses) for name, losses in terms.items()}
    order = sorted(terms, key=lambda name: ends[name])
    rows = spread(np.array([ends[name] for name in order]), LABEL, (LABEL / 2, HEIGHT - LABEL / 2))
    for name, row in zip(order, rows, strict=True):
        shapes = Shapes(image.size)
        ahead = np.array([[right + 6, ends[name]], [right + 14, ends[name]], [right + 34, row], [right + 40, row]])
        shapes.line(ahead, 3.6)
        shapes.paint(image, _color(name, terms))
        room = image.width - right - 48
        write(image, (right + 48, row), texts[name], size=SMALL, anchor="lm", room=room)


def spread(wanted: FloatArray, apart: float, limits: tuple[float, float]) -> FloatArray:
    """Ascending places (m,) near those `wanted` (ascending), at least `apart` from each other, within limits.

    Places that are too close become groups around their mean; where there is no room for all, they share what there is.
    """
    apart = min(apart, (limits[1] - limits[0]) / max(len(wanted) - 1, 1))
    groups: list[list[float]] = []  # sum of wanted first places, count
    for place in wanted - apart * np.arange(len(wanted)):
        groups.append([float(place), 1])
        while len(groups) > 1 and groups[-2][0] / groups[-2][1] > groups[-1][0] / groups[-1][1]:
            total, count = groups.pop()
            groups[-1] = [groups[-1][0] + total, groups[-1][1] + count]
    level = np.concatenate([np.full(int(count), total / count) for total, count in groups] or [np.zeros(0)])
    level = np.clip(level, limits[0], limits[1] - apart * (len(wanted) - 1))
    return np.asarray(level + apart * np.arange(len(wanted)))


def _end(axes: Axes, losses: FloatArray) -> float:
    """Row of the last loss that is drawn; the bottom where none is."""
    rows = axes.y(losses)
    known = rows[np.isfinite(rows)]
    return float(known[-1]) if len(known) else axes.box[3]


def _texts(terms: Mapping[str, FloatArray]) -> dict[str, str]:
    known = {name: losses[np.isfinite(losses)] for name, losses in terms.items()}
    return {name: f"{name}  {losses[-1]:.3g}" if len(losses) else f"{name}  none" for name, losses in known.items()}


def _color(name: str, terms: Mapping[str, FloatArray]) -> Color:
    if name == TOTAL:
        return INK
    others = [each for each in terms if each != TOTAL]
    return COLORS[others.index(name) % len(COLORS)]
