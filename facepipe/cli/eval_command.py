"""Run an exported ONNX deformer in onnxruntime and keep its outputs as arrays.

examples:
  facepipe eval head.onnx --set jawOpen=0.7 --bone jaw:rx=0.1 -o points.npz
  facepipe eval sliders.onnx --slider noseWidth=0.8 --set jawOpen=0.7 -o matrices.npz
"""

from __future__ import annotations

import argparse
import io
from pathlib import Path
from typing import Any

from facepipe import registry
from facepipe.cli.parser import add_output, add_pose, coefficients_of, output_of, pairs
from facepipe.cli.show import emit
from facepipe.core.atomic import write_bytes
from facepipe.core.errors import InputError
from facepipe.core.names import named


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments."""
    parser.add_argument("model", type=Path, metavar="MODEL", help=".onnx file of `facepipe export`")
    add_pose(parser)
    parser.add_argument(
        "--slider",
        action="append",
        default=[],
        metavar="SLIDER=VALUE",
        help="slider value, of a graph of `facepipe export --sliders`; may be given again",
    )
    add_output(parser, "arrays to write: .npz, one per output of the graph")
    parser.add_argument("--json", action="store_true", help="print shapes and ranges of the outputs as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Load, evaluate, save."""
    import numpy as np

    out = output_of(arguments, [arguments.model])
    if out.suffix != ".npz":
        raise InputError(out, f"suffix '{out.suffix}', expected .npz")
    if arguments.model.suffix.lower() != ".onnx":
        raise InputError(arguments.model, f"suffix '{arguments.model.suffix}', expected .onnx")
    graphs: Any = registry.exporter(arguments.model)
    deformer = graphs.Deformer(arguments.model)
    weights = named(pairs(arguments.set, "--set"), deformer.shapes, "--set", "shape")
    sliders = named(pairs(arguments.slider, "--slider"), deformer.sliders, "--slider", "slider")
    coefficients = coefficients_of(arguments.bone, deformer.joints, deformer.joint_names)
    outputs = deformer.evaluate(weights, coefficients=coefficients, sliders=sliders)
    buffer = io.BytesIO()
    np.savez(buffer, **outputs)
    write_bytes(out, buffer.getvalue())
    ranges: dict[str, dict[str, Any]] = {
        name: {"shape": list(array.shape), "minimum": float(array.min()), "maximum": float(array.max())}
        for name, array in outputs.items()
    }
    lines = [f"{name}: {tuple(one['shape'])}, {one['minimum']:g} to {one['maximum']:g}" for name, one in ranges.items()]
    emit({"path": str(out), "outputs": ranges}, "\n".join([*lines, str(out)]), as_json=arguments.json)
    return 0
