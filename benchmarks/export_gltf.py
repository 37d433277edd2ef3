"""Import and export of real faces: time, peak memory and file size, against Blender's exporter on the same stage.

Prints one table; --json writes every sample. README.md beside says what each figure means. Standard library only, so
that this process stays small: the sides are measured in children.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from arguments import add_common
from children import ChildError, Json, run_child
from export_table import table
from glb_content import content, dense_bytes, differences, reaches, read_json

_HERE = Path(__file__).resolve().parent
_OURS = _HERE / "facepipe_export.py"
_BLENDER = _HERE / "blender_export.py"
_OUR_SIDES = {"facepipe": "sparse", "facepipe_normals": "normals"}  # side -> variant of its child
_BLENDER_SIDES = {"blender": "matched", "blender_normals": "normals", "blender_defaults": "defaults"}
_PEER = {"blender_normals": "facepipe_normals"}  # what a side is compared to, if not to "facepipe"
AIM = 10.0  # times faster than Blender's export call


@dataclass(frozen=True)
class Source:
    """A real face: how the table calls it, its importer and its file below the data folder."""

    name: str
    kind: str
    file: str


SOURCES = (
    Source("ICT-FaceKit", "ict", "ict_facekit/ict_facekit.npz"),
    Source("MakeHuman", "makehuman", "makehuman/makehuman_head.npz"),
)


def main(words: Sequence[str] | None = None) -> int:
    """Measure, print the table, write the JSON."""
    arguments = _parser().parse_args(words)
    result = measure(arguments.data, arguments.blender_python, arguments.runs)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(result, indent=2, sort_keys=True) + "\n", encoding="utf-8")
    print(table(result))
    return 0


def measure(data: Path, blender_python: str | None, runs: int) -> Json:
    """All figures; faces and Blender are skipped with a reason where they are not there.

    :raises ChildError: facepipe's own side fails
    """
    found = [source for source in SOURCES if (data / source.file).is_file()]
    skipped = {one.name: f"no {data / one.file}" for one in SOURCES if one not in found}
    blender, reason = _blender(blender_python)
    if blender is None:
        skipped["Blender"] = reason
    with tempfile.TemporaryDirectory(prefix="facepipe-benchmark-") as folder:
        faces = [_face(source, data / source.file, Path(folder), blender, runs) for source in found]
    return {
        "benchmark": "export_gltf",
        "runs": runs,
        "aim": {"export_speedup": AIM},
        "machine": {"system": platform.platform(), "cpus": os.cpu_count(), "python": platform.python_version()},
        "faces": faces,
        "skipped": skipped,
    }


def _blender(python: str | None) -> tuple[str | None, str]:
    """The interpreter that has bpy, or None and why not."""
    if not python:
        return None, "not asked for: --blender-python or FACEPIPE_BLENDER_PYTHON names a Python with bpy"
    with tempfile.TemporaryDirectory() as folder:
        try:
            run_child(python, _BLENDER, "--check", Path(folder) / "report.json")
        except ChildError as error:
            return None, str(error)
    return python, ""


def _face(source: Source, file: Path, folder: Path, blender: str | None, runs: int) -> Json:
    """One face: imported, then exported by both sides in turn, so that both meet the same noise."""
    stage, glb, theirs, report = (folder / f"{source.kind}{end}" for end in (".usdc", ".glb", ".blender.glb", ".json"))
    samples: dict[str, list[Json]] = {"import": []} | {side: [] for side in (*_OUR_SIDES, *_BLENDER_SIDES)}
    for _ in range(runs):
        samples["import"].append(run_child(sys.executable, _OURS, "import", source.kind, file, stage, report))
    for _ in range(runs):
        for side, variant in _OUR_SIDES.items():
            out = glb if side == "facepipe" else folder / f"{side}.glb"
            samples[side].append(run_child(sys.executable, _OURS, "export", stage, out, variant, report))
        for side, variant in _BLENDER_SIDES.items() if blender is not None else ():
            out = theirs if side == "blender" else folder / f"{side}.glb"
            samples[side].append(run_child(str(blender), _BLENDER, stage, out, variant, report))
    quantised = run_child(sys.executable, _OURS, "export", stage, folder / "quantised.glb", "quantised", report)
    document = read_json(glb)
    ours = content(document)
    result: Json = {
        "name": source.name,
        "samples": samples,
        "median": {key: _medians(runs_of) for key, runs_of in samples.items() if runs_of},
        "content": {"facepipe": ours},
        "sizes": {
            "facepipe": {
                "sparse": glb.stat().st_size,
                "dense": dense_bytes(document),
                "quantised": quantised["glb_bytes"],
                "error_mm": {"sparse": samples["facepipe"][0]["error_mm"], "quantised": quantised["error_mm"]},
            }
        },
    }
    if blender is not None:
        dense = run_child(blender, _BLENDER, stage, folder / "dense.glb", "dense", report)
        result["sizes"]["blender"] = {"sparse": theirs.stat().st_size, "dense": dense["glb_bytes"]}
        result |= _comparison(result, document, read_json(theirs))
    return result


def _comparison(result: Json, ours: Json, theirs: Json) -> Json:
    """Whether both files hold the same, and the ratios Blender / facepipe of the medians."""
    own, other = reaches(ours), reaches(theirs)
    result["content"]["blender"] = content(theirs)
    off = [abs(own[key] - other[key]) * 1000 for key in own.keys() & other.keys()]
    medians = result["median"]
    return {
        "differences": differences(result["content"]["facepipe"], result["content"]["blender"]),
        "target_reach_difference_mm": max(off, default=None),
        "ratios": {
            side: {key: _ratio(medians[side][key], medians[_PEER.get(side, "facepipe")][key]) for key in _RATIOS}
            for side in _BLENDER_SIDES
        },
    }


_RATIOS = ("load_s", "export_s", "export_cpu_s", "again_s", "again_cpu_s", "load_export_s", "peak_bytes", "own_bytes")


def _ratio(theirs: float | None, ours: float | None) -> float | None:
    return theirs / ours if theirs and ours else None


def _medians(samples: Sequence[Json]) -> Json:
    """The median of every number; ``own_bytes`` is the peak over the baseline."""
    result: Json = {}
    for key, value in samples[0].items():
        numbers = isinstance(value, int | float) and all(sample[key] is not None for sample in samples)
        result[key] = statistics.median(sample[key] for sample in samples) if numbers else value
    known = result["peak_bytes"] is not None and result["baseline_bytes"] is not None
    result["own_bytes"] = result["peak_bytes"] - result["baseline_bytes"] if known else None
    return result


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "--blender-python",
        default=os.environ.get("FACEPIPE_BLENDER_PYTHON"),
        metavar="PYTHON",
        help="interpreter of the environment that has bpy; default FACEPIPE_BLENDER_PYTHON, skipped without",
    )
    add_common(parser, 5, "medians")
    return parser


if __name__ == "__main__":
    sys.exit(main())
