"""Write a face for the engine; the suffix of OUT says the format: .glb .gltf .onnx .vrm.

Exit code 1: done, but sliders learned by --distil are further off than --distil-threshold-mm.

examples:
  facepipe export head.usda -o head.glb
  facepipe export head.usda -o small.glb --engine three --quantize
  facepipe export head.usda -o head.onnx
  facepipe export head.usda --rename vrm -o head.glb
  facepipe export head.usda -o head.vrm --stub-body --authors me --license-url https://vrm.dev/licenses/1.0/
  facepipe export person.usda -o template.glb --pose rest
  facepipe export head.usda --sliders -o sliders.onnx
  facepipe export head.usda --sliders --distil -o learned.onnx
  facepipe export head.usda --neural head.fpnr -o rig.onnx
  facepipe export head.usda --neural head.fpnr -o rig.glb
  facepipe export head.usda --neural head.fpnr --encoder -o encoder.onnx
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from facepipe import registry
from facepipe.cli.export_distil import (
    HeldFace,
    add_distil_options,
    distilled,
    distilled_text,
    with_distilled,
)
from facepipe.cli.export_neural import (
    add_neural_option,
    check_neural,
    neural_encoder,
    neural_face,
    neural_options,
    neural_text,
    with_neural,
)
from facepipe.cli.parser import Parser, add_options, add_output, options_from, output_of
from facepipe.cli.rename import add_rename, rename_of
from facepipe.cli.show import emit, progress, warn
from facepipe.core.errors import InputError
from facepipe.core.reports import ExportReport


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments, and the options of the format in `words`; of all formats for --help."""
    parser.add_argument("face", type=Path, metavar="FACE", help="face stage")
    add_output(parser, "file to write: .glb .gltf .onnx .vrm")
    parser.add_argument("--json", action="store_true", help="print the report as JSON")
    finder = Parser(add_help=False, trust=False)
    finder.add_argument("-o", "--output")
    suffix = "" if {"-h", "--help"} & set(words) else Path(finder.parse_known_args(words)[0].output or "").suffix
    known = suffix.lower().removeprefix(".") in registry.suffixes()
    for name in [suffix] if known else [f".{one}" for one in registry.suffixes() if one != "gltf"]:
        add_options(parser, registry.exporter(f"out{name}").Options, f"options of {name}")
    add_rename(parser)
    add_neural_option(parser)
    add_distil_options(parser)


def run(arguments: argparse.Namespace) -> int:
    """Open, export, report."""
    import facepipe
    from facepipe.rig import implausible

    out = output_of(arguments, [arguments.face, *([arguments.neural] if arguments.neural else [])])
    check_neural(arguments)
    rename = rename_of(arguments)
    exporter = registry.exporter(out)
    beside = [file for file in registry.outputs(out) if file != out and file.exists()]
    if beside and not arguments.force:
        raise InputError(beside[0], "exists and would be written too, expected a new file (or --force)")
    with progress("export", 3 if arguments.distil else 2) as bar:
        face = facepipe.read(arguments.face)
        bar.update()
        options = neural_options(arguments, options_from(arguments, exporter.Options))
        neural, learned = neural_face(arguments, face, options), distilled(arguments, face)
        bar.update(learned is not None)
        encoder = neural_encoder(arguments, face, options)
        held = face if learned is None else HeldFace(learned[0])
        held = held if neural is None else HeldFace(neural.parts)
        held = held if encoder is None else HeldFace(face.parts(), encoder)
        if rename is not None:
            held = HeldFace(rename(held.parts()), encoder)
        report: ExportReport = exporter.export(held, out, options)
        bar.update()
    text = [as_text(report)]
    if neural is not None:
        report = with_neural(report, neural)
        text.append(neural_text(neural))
    if learned is not None:
        report = with_distilled(report, learned[1])
        text += distilled_text(learned[1])
    report = replace(report, warnings=(*report.warnings, *implausible(face.parts())))
    warn(report.warnings)
    emit(report, "\n".join(text), as_json=arguments.json)
    return 1 if learned is not None and learned[1].missed else 0


def as_text(report: ExportReport) -> str:
    """The report for people."""
    counts = ", ".join(f"{count:,} {name}" for name, count in report.counts.items())
    lines = [f"{report.path}: {report.bytes:,} bytes in {report.seconds:.2f} s: {counts}"]
    if report.pose_error is not None:
        error = "{max_mm:.3g} mm at most, {mean_mm:.2g} mean, over {shapes} shapes and {poses} poses"
        lines.append(f"rest: {report.pose}; expressions on top off by {error.format(**report.pose_error)}")
        if "sliders" in report.counts:
            lines.append("sliders moved elsewhere: {sliders_max_mm:.3g} mm at most".format(**report.pose_error))
    if report.error_mm is not None:
        lines.append(f"error at most {report.error_mm:.4f} mm")
    lines += [f"added: {line}" for line in report.added]
    lines += [f"not in the file: {line}" for line in report.dropped]
    return "\n".join(lines)
