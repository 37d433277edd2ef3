"""What report pages show beside words: pictures, bars, scales of colours and curves of losses, as HTML and SVG."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.markup import Markup, tag
from facepipe.pictures.overlay import NO_VALUE, STATIONS, ticks

if TYPE_CHECKING:
    from PIL.Image import Image

TOTAL = "total"
COLORS = (  # that colour-blind readers can distinguish, in this order
    "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#785ef0", "#808080", "#964b28", "#aabe3c",
)  # fmt: skip
_LOGARITHMIC = 20.0  # the largest over the smallest loss from which a logarithmic axis is used
_DECADES = 6.0  # a logarithmic axis shows at most these below the largest loss
_WIDTH, _HEIGHT, _LEFT, _TOP, _LEGEND, _LINE = 660, 330, 48, 36, 214, 19  # units of a chart


def figure(image: Image, caption: object, note: str = "", *, alt: str = "") -> Markup:
    """A picture that is part of the page, with a caption at the left below it and a note at the right."""
    kept = io.BytesIO()
    image.convert("RGB").save(kept, format="JPEG", quality=90, subsampling=0)
    address = f"data:image/jpeg;base64,{base64.b64encode(kept.getvalue()).decode()}"
    below = tag("figcaption", tag("span", caption), tag("small", note)) if caption or note else ""
    return tag("figure", tag("img", src=address, alt=alt, width=image.width, height=image.height), below)


def bar(limits: tuple[float, float], default: float, value: float) -> Markup:
    """A track from the least to the largest value, a bar from the default to the value, and a tick at the default."""
    low, high = limits
    shares = (np.array([default, value]) - low) / (high - low) if high > low else np.zeros(2)
    start, end = (100 * np.clip(shares, 0, 1)).tolist()
    left, long = min(start, end), abs(end - start)
    tick = min(max(start - 0.3, 0.0), 99.4)
    return tag(
        "svg",
        tag("rect", y=2, width=100, height=8, fill="var(--track)"),
        tag("rect", x=f"{left:.2f}", y=2, width=f"{long:.2f}", height=8,
            fill="var(--above)" if end > start else "var(--under)"),
        tag("rect", x=f"{tick:.2f}", width="0.6", height=12, fill="var(--muted)"),
        class_="bar", viewBox="0 0 100 12", preserveAspectRatio="none",
    )  # fmt: skip


def color_scale(limits: tuple[float, float], text: str, none: str = "") -> Markup:
    """The colours of a heat map from the least to the largest value in millimetres, and what grey stands for."""
    low, high = limits
    stations = (STATIONS * 255).round().astype(int).tolist()
    stops = [
        tag("stop", offset=f"{10 * number}%", stop_color=f"rgb({red},{green},{blue})")
        for number, (red, green, blue) in enumerate(stations)
    ]
    name = "heat"  # the same gradient wherever it stands
    placed = [((value - low) / (high - low), figures) for value, figures in ticks(low, high)]
    marks = [
        tag(
            "text",
            text,
            x=f"{at * 560:.1f}",
            y=34,
            text_anchor="start" if at < 0.01 else "end" if at > 0.99 else "middle",
        )
        for at, text in placed
    ]
    gradient = tag("defs", tag("linearGradient", *stops, id=name))
    strip = tag("rect", width=560, height=14, rx=2, fill=f"url(#{name})")
    drawn = tag("svg", gradient, strip, *marks, viewBox="0 0 560 40", font_size=12, fill="currentColor")
    grey = ",".join(str(round(255 * level)) for level in NO_VALUE)
    square = tag("svg", tag("rect", width=12, height=12, rx=2, fill=f"rgb({grey})"), width=12, height=12)
    return tag("div", tag("small", text, ", mm", *((" · ", square, " ", none) if none else ())), drawn, class_="scale")


@dataclass(frozen=True, kw_only=True)
class Axes:
    """Where steps and losses are in a chart."""

    steps: int  # the last
    limits: tuple[float, float]  # losses at the bottom and the top
    logarithmic: bool

    def x(self, step: float) -> float:
        """Column of a step; a single step stands at the left."""
        return _LEFT + step / max(self.steps, 1) * (_WIDTH - _LEFT - _LEGEND)

    def y(self, losses: FloatArray) -> FloatArray:
        """Rows of losses (m,): NaN where there is none, or none above 0 on a logarithmic axis."""
        known = np.isfinite(losses) & ((losses > 0) | (not self.logarithmic))
        low, high, at = *self.limits, np.where(known, losses, self.limits[1])
        if self.logarithmic:
            low, high, at = np.log10(low), np.log10(high), np.log10(at)
        share = np.clip((at - low) / (high - low), 0.0, 1.0)
        return np.where(known, _HEIGHT - share * (_HEIGHT - _TOP), np.nan)

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


def loss_chart(history: Sequence[Mapping[str, float]], title: str = "") -> Markup:
    """A curve for every term as SVG, the total the boldest; NaN and infinity leave gaps. A file of its own, too.

    :param history: by step, term -> weighted loss
    :param title: above the curves
    """
    # losses by step for each term, the total first; NaN where a step lacks one
    names = sorted({name for step in history for name in step}, key=lambda name: (name != TOTAL, name))
    losses = {name: np.array([float(step.get(name, np.nan)) for step in history]) for name in names}
    terms = {name: np.where(np.isfinite(values), values, np.nan) for name, values in losses.items()}
    if not terms:
        return _chart(60, tag("text", "no steps were made", x=0, y=20, fill_opacity=0.6))
    axes = _axes(terms, len(history))
    others = [name for name in terms if name != TOTAL]
    colors = {name: COLORS[number % len(COLORS)] for number, name in enumerate(others)} | {TOTAL: "currentColor"}
    curves = []
    for name in reversed(terms):
        rows = axes.y(terms[name])
        known = np.flatnonzero(np.isfinite(rows))
        runs = np.split(known, np.flatnonzero(np.diff(known) > 1) + 1) if len(known) else []
        # a run of one step becomes a dot: a line of no length with round ends.
        lines = ("L".join(f"{axes.x(step):.1f} {rows[step]:.1f}" for step in (*run, run[-1])) for run in runs)
        look = {"stroke": colors[name], "stroke_width": 2.4 if name == TOTAL else 1.6}
        round_ends = {"stroke_linejoin": "round", "stroke_linecap": "round"}
        curves.append(tag("path", d="".join(f"M{line}" for line in lines), fill="none", **look, **round_ends))
    height = max(_HEIGHT + 44, _TOP + _LINE * len(terms) + 8)
    return _chart(height, tag("text", title, x=0, y=14), *_grid(axes), *curves, *_legend(terms, colors))


def training_chart(curve: FloatArray) -> bytes:
    """An SVG file: what was left of learned and of watched frames, by step.

    :param curve: (checks, 3) step, learned, watched; without any, the picture says that no steps were made
    """
    history = []
    if len(curve):
        steps = np.arange(int(curve[-1, 0]) + 1)
        pairs = zip(*(np.interp(steps, curve[:, 0], curve[:, column]).tolist() for column in (1, 2)), strict=True)
        history = [{"learned": learned, "watched": watched} for learned, watched in pairs]
    title = "RMS error of learned and other frames, as a share of what is not straight"
    chart = loss_chart(history, title=title)
    return chart.replace("<svg ", '<svg style="background:#fff" ', 1).encode()


def _chart(height: int, *content: Markup) -> Markup:
    return tag(
        "svg", *content, xmlns="http://www.w3.org/2000/svg", viewBox=f"-4 0 {_WIDTH + 8} {height}", width=_WIDTH,
        font_family="system-ui,sans-serif", font_size=12, fill="currentColor",
    )  # fmt: skip


def _axes(terms: Mapping[str, FloatArray], count: int) -> Axes:
    known = np.concatenate([losses[np.isfinite(losses)] for losses in terms.values()])
    positive = known[known > 0]
    if len(positive) and not (known < 0).any() and positive.max() > _LOGARITHMIC * positive.min():
        high = float(positive.max()) * 1.2
        limits = max(float(positive.min()) / 1.2, high / 10**_DECADES), high
        return Axes(steps=count - 1, limits=limits, logarithmic=True)
    low, high = float(known.min(initial=0.0)), float(known.max(initial=0.0))
    top = low + (high - low) * 1.05
    return Axes(steps=count - 1, limits=(low, top) if top > low else (0.0, 1.0), logarithmic=False)


def _grid(axes: Axes) -> Iterator[Markup]:
    right = _WIDTH - _LEGEND
    for value, text in axes.ticks:
        row = f"{float(axes.y(np.array([value]))[0]):.1f}"
        yield tag("line", x1=_LEFT, x2=right, y1=row, y2=row, stroke="currentColor", stroke_opacity=0.15)
        yield tag("text", text, x=_LEFT - 8, y=row, dy="0.35em", text_anchor="end", fill_opacity=0.65)
    yield tag("line", x1=_LEFT, x2=right, y1=_HEIGHT, y2=_HEIGHT, stroke="currentColor", stroke_opacity=0.5)
    whole = [(step, text) for step, text in ticks(0, max(axes.steps, 1)) if "." not in text and step <= axes.steps]
    for step, text in whole:
        column = f"{axes.x(step):.1f}"
        yield tag("line", x1=column, x2=column, y1=_HEIGHT, y2=_HEIGHT + 4, stroke="currentColor", stroke_opacity=0.5)
        yield tag("text", text, x=column, y=_HEIGHT + 18, text_anchor="middle", fill_opacity=0.65)
    yield tag("text", "step", x=(_LEFT + right) // 2, y=_HEIGHT + 36, text_anchor="middle", fill_opacity=0.65)


def _legend(terms: Mapping[str, FloatArray], colors: Mapping[str, str]) -> Iterator[Markup]:
    """Names with their last losses at the right, the largest first."""
    last = {name: losses[np.isfinite(losses)][-1:] for name, losses in terms.items()}
    order = sorted(terms, key=lambda name: -last[name][0] if len(last[name]) else np.inf)
    left = _WIDTH - _LEGEND + 16
    for number, name in enumerate(order):
        row = _TOP + 4 + _LINE * number
        yield tag("line", x1=left, x2=left + 16, y1=row, y2=row, stroke=colors[name], stroke_width=3)
        yield tag("text", name, tag("title", name), x=left + 24, y=row, dy="0.35em")
        value = f"{last[name][0]:.3g}" if len(last[name]) else "none"
        yield tag("text", value, x=_WIDTH, y=row, dy="0.35em", text_anchor="end", fill_opacity=0.65)


def table_of_bars(
    rows: Sequence[tuple[str, Sequence[tuple[Markup, float] | None]]], caption: str = "", titles: Sequence[str] = ()
) -> Markup:
    """A name a row, and for each of its columns a bar with its number; None leaves a place empty."""
    head = tag("tr", tag("th"), *(tag("th", title, colspan=2) for title in titles)) if titles else ""
    lines = []
    for name, places in rows:
        cells = [tag("td", name)]
        for place in places:
            if place:
                cells += [tag("td", place[0], class_="track"), tag("td", f"{place[1]:.2f}", class_="number")]
            else:
                cells.append(tag("td", colspan=2))
        lines.append(tag("tr", *cells))
    above = tag("caption", caption) if caption else ""
    columns = max((len(places) for _, places in rows), default=1)
    widths = [tag("col", style=f"width:{'36%' if columns == 1 else '240px'}")]
    widths += [tag("col"), tag("col", style="width:70px")] * columns
    return tag("table", above, tag("colgroup", *widths), head, *lines, class_="bars")
