"""Reports of photo fits as text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.core.texts import table

if TYPE_CHECKING:
    from facepipe.parts import Slider
    from facepipe.processors.photo_fit.report import PhotoFitReport

ENDS = {
    "iterations": "all steps made",
    "loss-threshold": "ended at the loss asked for",
    "not-finite": "ended by a loss that was not finite",
}
_SHOWN = 5  # names of a list
_OFF = 0.01  # of a slider's range, or a weight: what counts as set


def as_text(out: Path, report: PhotoFitReport, sliders: Sequence[Slider]) -> str:
    """How near each photo is, and what was found."""
    from facepipe.processors.photo_fit.report import percent

    count = len(report.photos)
    total = report.losses.get("total")
    loss = f", loss {total.first:.4g} to {total.last:.4g}" if total and report.steps else ""
    steps = f"{report.steps} steps in {report.seconds:.1f} s"
    head = f"{out}: {count} photo{'s' * (count != 1)}, {steps}, {ENDS[report.stopped]}{loss}"
    rows: list[list[object]] = [["landmarks off by", "pixels", "of the outer eye corners' distance", "expression"]]
    for name, photo in report.photos.items():
        share = f"{percent(photo):.1f} %"
        rows.append([name, f"{photo.landmark_error_px:.2f}", share, _largest(photo.expressions, {})])
    ranges = {one.name: one for one in sliders}
    off = {name: value - ranges[name].default for name, value in report.sliders.items()}
    spans = {name: ranges[name].maximum - ranges[name].minimum for name in off}
    moved = sum(abs(value) > _OFF * spans[name] for name, value in off.items())
    last = f"{moved} of {len(off)} sliders off their defaults: {_largest(off, spans, report.sliders)}"
    lines = [head, table(rows), last]
    if report.beyond_limits:
        lines.append(f"beyond bone limits: {', '.join(report.beyond_limits[:_SHOWN])}")
    return "\n".join(lines)


def _largest(off: Mapping[str, float], spans: Mapping[str, float], values: Mapping[str, float] | None = None) -> str:
    """The names that are furthest off, with their values."""
    shares = {name: abs(value) / max(spans.get(name, 1.0), 1e-9) for name, value in off.items()}
    order = sorted((name for name, share in shares.items() if share > _OFF), key=lambda name: (-shares[name], name))
    shown = ", ".join(f"{name} {(values or off)[name]:.2f}" for name in order[:_SHOWN])
    return (shown + (", ..." if len(order) > _SHOWN else "")) or "none"
