"""`facepipe export --neural`: a face that a neural rig moves."""

from __future__ import annotations

import argparse
import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facepipe.cli.parser import add_options, options_from
from facepipe.core.errors import InputError
from facepipe.core.reports import ExportReport

if TYPE_CHECKING:
    from facepipe.processors.neural_rig import AttachedNeuralRig
    from facepipe.rig.neural_encoder import NeuralEncoder
    from facepipe.stage import Face


@dataclass(frozen=True, kw_only=True)
class NeuralExportReport(ExportReport):
    """What was written, and what shapes leave out."""

    dropped_mm: float  # by which points can be off for offsets that are left out
    clips_mm: float  # by which points of clips are off at most


def add_neural_option(parser: argparse.ArgumentParser) -> None:
    """`--neural` and what of its shapes is kept."""
    from facepipe.processors.neural_rig import AttachOptions

    text = "neural rig (.fpnr) whose controls are the sliders of FACE; a .onnx is the graph of its controls"
    parser.add_argument("--neural", type=Path, metavar="RIG", help=text)
    add_options(parser, AttachOptions, "options of --neural", sparse=True)


def check_neural(arguments: argparse.Namespace) -> None:
    """:raises InputError: flags that don't go together"""
    if arguments.neural is not None and arguments.distil:
        raise InputError("--neural", "given with --distil, expected one of them")
    for flag in ("offset_tolerance_mm", "keep_shapes"):
        if arguments.neural is None and hasattr(arguments, flag):
            raise InputError(f"--{flag.replace('_', '-')}", "given without --neural, expected both")


def neural_face(arguments: argparse.Namespace, face: Face, options: Any) -> AttachedNeuralRig | None:
    """The face with its neural rig; None without `--neural`, or where the graph of its encoder is asked for.

    :raises InputError: a damaged file
    :raises TopologyError: other meshes, joints or skin than the rig was learned on
    """
    if arguments.neural is None or getattr(options, "encoder", False):
        return None
    from facepipe.processors.neural_rig import AttachNeuralRig, AttachOptions, load_neural_rig

    attach = AttachNeuralRig(options=options_from(arguments, AttachOptions))
    return attach(face.parts(), load_neural_rig(arguments.neural), str(arguments.face))


def neural_options(arguments: argparse.Namespace, options: Any) -> Any:
    """The options of an exporter: a graph is that of the controls, or from points back to them."""
    if arguments.neural is None or not hasattr(options, "sliders") or options.encoder:
        return options
    return dataclasses.replace(options, sliders=True)


def neural_encoder(arguments: argparse.Namespace, face: Face, options: Any) -> NeuralEncoder | None:
    """The encoder in the file of the rig, where its graph is asked for.

    :raises InputError: a rig without one
    :raises TopologyError: other meshes than it was learned on
    """
    if arguments.neural is None or not getattr(options, "encoder", False):
        return None
    from facepipe.processors.database import Topology
    from facepipe.processors.neural_rig import load_encoder

    encoder = load_encoder(arguments.neural)
    encoder.check(Topology.of(face.parts()).digest, str(arguments.face))
    return encoder


def with_neural(report: ExportReport, neural: AttachedNeuralRig) -> NeuralExportReport:
    """The report of an export of a neural rig."""
    own = {field.name: getattr(report, field.name) for field in dataclasses.fields(report)}
    own["warnings"] = (*report.warnings, *neural.warnings)
    return NeuralExportReport(**own, dropped_mm=neural.dropped_mm, clips_mm=neural.clips_mm)


def neural_text(neural: AttachedNeuralRig) -> str:
    """The report for people."""
    clips = f", in clips by {neural.clips_mm:.4f} mm" if neural.clips_mm else ""
    left = f"points are off by at most {neural.dropped_mm:.4f} mm for offsets that its shapes leave out"
    return f"neural rig: {left}{clips}"
