"""Reports of sliders that were authored, made or set as text."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from facepipe.core.reports import Report
from facepipe.core.texts import table
from facepipe.processors.sliders.author_network import AuthorNetworkReport
from facepipe.processors.sliders.author_sliders import AuthorSlidersReport
from facepipe.processors.sliders.set_sliders import SetSlidersReport
from facepipe.processors.sliders.shape_report import MadeSlider, ShapeSlidersReport


def as_text(out: Path, report: Report) -> str:
    """What was authored, made or set."""
    if isinstance(report, AuthorSlidersReport):
        return _authored(out, report)
    if isinstance(report, AuthorNetworkReport):
        layers = " -> ".join(map(str, report.layers))
        replaced = ", in place of another" if report.replaced else ""
        return f"{out}: a network {layers}{replaced}, over {report.channels} channels and {report.shapes} shapes"
    if isinstance(report, SetSlidersReport):
        what = ", ".join(f"{name} {value:g}" for name, value in report.values.items()) or "all at their defaults"
        return f"{out}: {what}: {report.joints} joints off rest, {report.shapes} shapes on"
    assert isinstance(report, ShapeSlidersReport)
    return _made(out, report)


def _authored(out: Path, report: AuthorSlidersReport) -> str:
    kept = f", {len(report.replaced)} of them replaced" if report.replaced else ""
    text = f"{out}: {len(report.sliders)} sliders{kept}, over {report.channels} channels and {report.shapes} shapes"
    return text + (f", {len(report.dropped)} dropped" if report.dropped else "")


def _made(out: Path, report: ShapeSlidersReport) -> str:
    made = {**report.sliders, **report.left_out}
    lines = [f"{out}: {_count(report)} in {report.seconds:.1f} s"]
    rows: list[Sequence[object]] = [_HEAD]
    for group, reach in report.groups.items():
        numbers = (f"{reach.reach:.2f}", f"{reach.rms_mm:.2f}", "", f"{reach.left_rms_mm:.2f}")
        rows.append((group or "(no group)", "", "", "", *numbers))
        rows += [_row(name, one) for name, one in made.items() if one.group == group]
    return "\n".join([*lines, table(rows)])


_HEAD = ("distance, mm", "by", "joints", "channels", "reach", "RMS", "max", "RMS left", "max left")


def _row(name: str, one: MadeSlider) -> tuple[object, ...]:
    rms, left = (
        math.sqrt(sum(value**2 for value in own) / len(one.ends))
        for own in ([end.rms_mm for end in one.ends], [end.left_rms_mm for end in one.ends])
    )
    largest, last = max(end.max_mm for end in one.ends), max(end.left_max_mm for end in one.ends)
    numbers = (f"{one.reach:.2f}", f"{rms:.2f}", f"{largest:.1f}", f"{left:.2f}", f"{last:.1f}")
    return (f"  {name}", one.by or "left out", one.joints, one.channels, *numbers)


def _count(report: ShapeSlidersReport) -> str:
    shapes = sum(len(one.ends) for one in (*report.sliders.values(), *report.left_out.values()))
    parts = [f"{len(report.sliders)} sliders of {shapes} shapes"]
    for what, names in (("left out", report.left_out), ("replaced", report.replaced), ("dropped", report.dropped)):
        parts += [f"{len(names)} {what}"] if names else []
    return ", ".join(parts)
