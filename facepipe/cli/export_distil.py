"""`facepipe export --sliders --distil`: the graph of a small network that has learned the sliders."""

from __future__ import annotations

import argparse
import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING

from facepipe.core.errors import InputError
from facepipe.core.reports import ExportReport

if TYPE_CHECKING:
    from facepipe.parts import FaceParts
    from facepipe.processors.sliders import DistilReport
    from facepipe.rig.neural_encoder import NeuralEncoder
    from facepipe.stage import Face

_PREFIX = "distil_"


@dataclass(frozen=True, kw_only=True)
class DistilledExportReport(ExportReport):
    """What was written, and how good the learned sliders in it are."""

    distilled: DistilReport


@dataclass(frozen=True)
class HeldFace:
    """What an exporter needs of a face."""

    held: FaceParts
    encoder: NeuralEncoder | None = None  # of a neural rig

    def parts(self) -> FaceParts:
        """The face as arrays."""
        return self.held


def add_distil_options(parser: argparse.ArgumentParser) -> None:
    """`--distil` and its settings."""
    group = parser.add_argument_group(
        "options of .onnx --sliders --distil (needs torch: pip install 'facepipe[train]')"
    )
    text = "a small learned network in place of curves and of a larger network; tells how far off it is"
    group.add_argument("--distil", action="store_true", help=text)

    def add(name: str, kind: type, text: str, choices: tuple[str, ...] | None = None) -> None:
        flag, shown = f"--distil-{name.replace('_', '-')}", None if choices else name.upper()
        absent = argparse.SUPPRESS
        group.add_argument(
            flag, dest=_PREFIX + name, type=kind, default=absent, metavar=shown, choices=choices, help=text
        )

    add("width", int, "hidden units, 1 to 1024 (default 32)")
    add("activation", str, "relu bends sharply, as curves do; tanh smoothly (default relu)", ("relu", "tanh"))
    add("seed", int, "of samples and first weights (default 0)")
    add("steps", int, "of training at most, 100 to 200000 (default 6000)")
    add("threshold_mm", float, "exit code 1 where a point is further off than this [mm] (default 0.1)")


def distilled(arguments: argparse.Namespace, face: Face) -> tuple[FaceParts, DistilReport] | None:
    """The face with learned sliders; None without `--distil`.

    :raises InputError: flags that don't go together, or as `DistilSliders` does
    """
    settings = {key.removeprefix(_PREFIX): value for key, value in vars(arguments).items() if key.startswith(_PREFIX)}
    if not arguments.distil:
        if settings:
            raise InputError(f"--distil-{next(iter(settings)).replace('_', '-')}", "without --distil, expected both")
        return None
    if not getattr(arguments, "sliders", False):
        raise InputError("--distil", "is for the graph of the sliders, expected --sliders too, and a .onnx as OUT")
    from facepipe.processors.sliders import DistilSliders

    return DistilSliders(**settings)(face.parts())


def with_distilled(report: ExportReport, distilled: DistilReport) -> DistilledExportReport:
    """The report of an export of learned sliders."""
    own = {field.name: getattr(report, field.name) for field in dataclasses.fields(report)}
    points = distilled.points_mm
    packed = report.error_mm or 0.0  # of weights in fewer bytes
    error = None if points is None else points.max + packed
    own |= {"warnings": (*report.warnings, *distilled.warnings), "error_mm": error}
    return DistilledExportReport(**own, distilled=distilled)


def distilled_text(report: DistilReport) -> list[str]:
    """The report for people."""
    if not report.sliders:
        return []
    what = f"{report.channels} channels and {report.shapes} shapes of {len(report.sliders)} sliders"
    lines = [f"learned: {what}, {report.width} {report.activation} units, {report.steps} steps"]
    units = {"translation": "stage units", "rotation": "rad", "scale": "of rest"}
    rows = [(name, one, units[name]) for name, one in report.coefficients.items()]
    rows += [("shape weights", report.shape_weights, "")] if report.shape_weights else []
    rows += [("points", report.points_mm, "mm")] if report.points_mm else []
    lines += [
        f"  {name}: mean {one.mean:.2g}, p95 {one.p95:.2g}, max {one.max:.2g} {unit}".rstrip()
        for name, one, unit in rows
    ]
    return [*lines, f"  off so far over {report.vectors} random slider vectors that were not trained on"]
