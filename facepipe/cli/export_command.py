"""Write a face for the engine; the suffix of OUT says the format: .glb .gltf .onnx .vrm.

Exit code 1: done, but sliders learned by --distil are further off than --distil-threshold-mm.

examples:
  facepipe export head.usdc -o head.glb
  facepipe export head.usdc -o small.glb --engine three --quantize
  facepipe export head.usdc -o head.onnx
  facepipe export head.usdc --rename vrm -o head.glb
  facepipe export head.usdc -o head.vrm --stub-body --authors me --license-url https://vrm.dev/licenses/1.0/
  facepipe export person.usdc -o template.glb --pose rest
  facepipe export lods.usdc -o lods.glb --lods
  facepipe export lods.usdc -o far.glb --lod 2
  facepipe export head.usdc --sliders -o sliders.onnx
  facepipe export head.usdc --sliders --distil -o learned.onnx
  facepipe export head.usdc --neural head.fpnr -o rig.onnx
  facepipe export head.usdc --neural head.fpnr -o rig.glb
  facepipe export head.usdc --neural head.fpnr --encoder -o encoder.onnx
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path

from facepipe import registry
from facepipe.cli.parser import Parser, add_options, add_output, add_rename, output_of
from facepipe.cli.show import emit, noted_names, progress, warn
from facepipe.core.reports import ExportReport


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments, and the options of the format in `words`; of all formats for --help."""
    parser.add_argument("face", type=Path, metavar="FACE", help="face stage")
    add_output(parser, "file to write: .glb .gltf .onnx .vrm")
    parser.add_argument("--json", action="store_true", help="print the report as JSON")
    level = "level of detail of a face that `facepipe lod` made, 0 the finest (default 0)"
    parser.add_argument("--lod", type=int, default=0, metavar="N", help=level)
    finder = Parser(add_help=False, common=False)
    finder.add_argument("-o", "--output")
    suffix = "" if {"-h", "--help"} & set(words) else Path(finder.parse_known_args(words)[0].output or "").suffix
    known = suffix.lower().removeprefix(".") in registry.suffixes()
    for name in [suffix] if known else [f".{one}" for one in registry.suffixes() if one != "gltf"]:
        add_options(parser, registry.exporter(f"out{name}").Options, f"options of {name}")
    add_rename(parser, words)
    rig = "neural rig (.fpnr) whose controls are the sliders of FACE; a .onnx is the graph of its controls"
    parser.add_argument("--neural", type=Path, metavar="RIG", help=rig)
    # what declares further options is loaded only for help, and for a line with flags that may be some
    flags = {word.partition("=")[0] for word in words if word.startswith("-")}
    further = {"-h", "--help"} & flags or not flags <= {*parser._option_string_actions, "--distil"}
    if further:
        add_options(parser, registry.neural_rigs().Options, "options of --neural", sparse=True)
    learned = "a small learned network in place of curves and of a larger network; the report says how far off it is"
    group = parser.add_argument_group("options of .onnx --sliders (needs torch: pip install 'facepipe[train]')")
    group.add_argument("--distil", action="store_true", help=learned)
    if further:
        from facepipe.verbs.sliders.options import DISTIL, DistilOptions

        add_options(group, DistilOptions, prefix=DISTIL, sparse=True)
        names = [one.name for one in dataclasses.fields(registry.neural_rigs().Options)]
        parser.set_defaults(further=[*names, *(f"{DISTIL}{one.name}" for one in dataclasses.fields(DistilOptions))])


def run(arguments: argparse.Namespace) -> int:
    """Export, report."""
    from facepipe.exporting import DistilledExportReport, export

    out = output_of(arguments, [arguments.face, *([arguments.neural] if arguments.neural else [])])
    names = [field.name for field in dataclasses.fields(registry.exporter(out).Options)]
    names += getattr(arguments, "further", ())
    report = export(
        arguments.face,
        out,
        overwrite=arguments.force,
        rename=arguments.rename,
        neural=arguments.neural,
        distil=arguments.distil,
        lod=arguments.lod,
        watch=progress,
        **{name: getattr(arguments, name) for name in names if hasattr(arguments, name)},
    )
    warn(report.warnings)
    noted_names(arguments.rename, report.renamed)
    emit(report, _as_text(report), as_json=arguments.json)
    return 1 if isinstance(report, DistilledExportReport) and report.distilled.missed else 0


def _as_text(report: ExportReport) -> str:
    """The report for people."""
    from facepipe.exporting import DistilledExportReport, NeuralExportReport

    counts = ", ".join(f"{count:,} {name}" for name, count in report.counts.items())
    lines = [f"{report.path}: {report.bytes:,} bytes in {report.seconds:.2f} s: {counts}"]
    if report.pose_error is not None:
        error = "{max_mm:.3g} mm at most, {mean_mm:.2g} mean, over {shapes} shapes and {poses} poses"
        lines.append(f"rest: {report.pose}; expressions on top off by {error.format(**report.pose_error)}")
        lines.append("exact where the engine keeps scaled joints: --pose set-joints")
        if "sliders" in report.counts:
            lines.append("sliders moved elsewhere: {sliders_max_mm:.3g} mm at most".format(**report.pose_error))
    if report.error_mm is not None:
        lines.append(f"error at most {report.error_mm:.4f} mm")
    lines += [f"chosen: {line}" for line in report.chosen]
    lines += [f"added: {line}" for line in report.added]
    lines += [f"not in the file: {line}" for line in report.dropped]
    if isinstance(report, NeuralExportReport):
        clips = f", in clips by {report.clips_mm:.4f} mm" if report.clips_mm else ""
        left = f"points are off by at most {report.dropped_mm:.4f} mm for offsets that its shapes leave out"
        lines.append(f"neural rig: {left}{clips}")
    if isinstance(report, DistilledExportReport) and report.distilled.sliders:
        learned = report.distilled
        what = f"{learned.channels} channels and {learned.shapes} shapes of {len(learned.sliders)} sliders"
        lines.append(f"learned: {what}, {learned.width} {learned.activation} units, {learned.steps} steps")
        units = {"translation": "stage units", "rotation": "rad", "scale": "of rest"}
        rows = [(name, one, units[name]) for name, one in learned.coefficients.items()]
        rows += [("shape weights", learned.shape_weights, "")] if learned.shape_weights else []
        rows += [("points", learned.points_mm, "mm")] if learned.points_mm else []
        lines += [
            f"  {name}: mean {error.mean:.2g}, p95 {error.p95:.2g}, max {error.max:.2g} {unit}".rstrip()
            for name, error, unit in rows
        ]
        lines.append(f"  off so far over {learned.vectors} random slider vectors that were not trained on")
    return "\n".join(lines)
