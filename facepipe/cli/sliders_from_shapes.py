"""`facepipe sliders --from-shapes`: its flags, and its report as text."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.cli.parser import add_options, given_options
from facepipe.core.texts import table

if TYPE_CHECKING:
    from facepipe.processors.sliders import MadeSlider, ShapeSlidersReport, SlidersFromShapes


def add_shape_options(parser: argparse.ArgumentParser) -> None:
    """The flags that go with --from-shapes; they are there only where they are given."""
    from facepipe.processors.sliders import ShapeSliderOptions

    group = parser.add_argument_group("with --from-shapes")
    text = "limits of the bones over those of the rig, as in docs/bones.md (default none)"
    group.add_argument("--limits", type=Path, default=argparse.SUPPRESS, metavar="JSON", help=text)
    add_options(group, ShapeSliderOptions, sparse=True)


def shape_flags(arguments: argparse.Namespace) -> tuple[str, ...]:
    """Those of them that are given."""
    from facepipe.processors.sliders import ShapeSliderOptions

    given = [*given_options(arguments, ShapeSliderOptions), *(["limits"] if hasattr(arguments, "limits") else [])]
    return tuple(f"--{name.replace('_', '-')}" for name in given)


def limit_files(arguments: argparse.Namespace) -> list[Path]:
    """The file of limits, where there is one."""
    return [arguments.limits] if hasattr(arguments, "limits") else []


def maker_of(arguments: argparse.Namespace) -> SlidersFromShapes:
    """What to make of the face.

    :raises InputError: options out of range, or a file of limits that can't be read
    """
    from facepipe.processors.fit_bones import LimitRules, read_limits
    from facepipe.processors.sliders import ShapeSliderOptions, SlidersFromShapes

    own = limit_files(arguments)
    return SlidersFromShapes(
        shapes=arguments.from_shapes,
        limits=read_limits(own[0]) if own else LimitRules(),
        drop=arguments.replace,
        **given_options(arguments, ShapeSliderOptions),
    )


def as_text(out: Path, report: ShapeSlidersReport) -> str:
    """What was made, group by group."""
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
