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
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from arguments import add_common
from children import ChildError, Json, export_times, is_side, peak_memory, run_child, run_side
from glb_content import content, dense_bytes, differences, reaches, read_json
from tables import aligned, mib, ms, times

_BLENDER = Path(__file__).resolve().with_name("blender_export.py")
_OUR_SIDES = {"facepipe": "sparse", "facepipe_normals": "normals"}  # side -> variant of its child
_BLENDER_SIDES = {"blender": "matched", "blender_normals": "normals", "blender_defaults": "defaults"}
_PEER = {"blender_normals": "facepipe_normals"}  # what a side is compared to, if not to "facepipe"
AIM = 10.0  # times faster than Blender's export call
_RATIOS = ("load_s", "export_s", "export_cpu_s", "again_s", "again_cpu_s", "load_export_s", "peak_bytes", "own_bytes")
Row = tuple[str, str, str, str, str]
_TIMES = (
    ("load_s", "open and read the stage"),
    ("load_export_s", "read and export, same settings"),
)
_EXPORT = (
    ("export_s", "first of the process"),
    ("export_cpu_s", "first, processor time"),
    ("again_s", "warm"),
    ("again_cpu_s", "warm, processor time"),
)
_SETTINGS = (
    ("facepipe", "blender", "export call, same settings"),  # no normals in targets on either side
    ("facepipe_normals", "blender_normals", "export call, both with normals in targets"),
    ("facepipe", "blender_defaults", "export call, Blender's defaults"),  # with normals in targets, only Blender's
)
_MEMORY = (
    ("peak_bytes", "peak memory of read and export"),
    ("own_bytes", "  the same over the memory after imports"),
)
_COUNTS = ("meshes", "vertices", "triangles", "targets", "shapes", "joints")


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
        samples["import"].append(run_side(__file__, "import", source.kind, file, stage, report))
    for _ in range(runs):
        for side, variant in _OUR_SIDES.items():
            out = glb if side == "facepipe" else folder / f"{side}.glb"
            samples[side].append(run_side(__file__, "export", stage, out, variant, report))
        for side, variant in _BLENDER_SIDES.items() if blender is not None else ():
            out = theirs if side == "blender" else folder / f"{side}.glb"
            samples[side].append(run_child(str(blender), _BLENDER, stage, out, variant, report))
    quantised = run_side(__file__, "export", stage, folder / "quantised.glb", "quantised", report)
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


def table(result: Json) -> str:
    """One table for people: a row a figure, the ratio always Blender / facepipe; what was skipped below."""
    theirs = next((face["median"]["blender"]["version"] for face in result["faces"] if "ratios" in face), "")
    rows: list[Row] = [("face", "figure", "facepipe", f"Blender {theirs}".strip(), "ratio")]
    for face in result["faces"]:
        rows += _rows(face)
    lines = aligned(rows) if result["faces"] else []
    lines += [f"skipped: {name}: {reason}" for name, reason in result["skipped"].items()]
    aim = result["aim"]["export_speedup"]
    runs = result["runs"]
    return "\n".join(
        [*lines, f"median of {runs} run{'s' * (runs > 1)}, ratio = Blender / facepipe, aim {aim:g} for exports"]
    )


def _rows(face: Json) -> list[Row]:
    name = face["name"]
    median, ratios = face["median"], face.get("ratios", {})
    ours, theirs = median["facepipe"], median.get("blender", {})
    matched = ratios.get("blender", {})
    rows = [
        (name, "import: source to arrays", ms(median["import"]["read_s"]), "", ""),
        (name, "import: arrays to a saved stage", ms(median["import"]["save_s"]), "", ""),
        (name, "peak memory of the import", mib(median["import"]["peak_bytes"]), "", ""),
    ]
    rows += [(name, text, ms(ours[key]), ms(theirs.get(key)), times(matched.get(key))) for key, text in _TIMES]
    for own, side, settings in _SETTINGS:
        other, ratio = median.get(side, {}), ratios.get(side, {})
        if other or side != "blender_defaults":
            rows += [
                (name, f"{settings}: {text}", ms(median[own][key]), ms(other.get(key)), times(ratio.get(key)))
                for key, text in _EXPORT
            ]
    rows += [(name, text, mib(ours[key]), mib(theirs.get(key)), times(matched.get(key))) for key, text in _MEMORY]
    return rows + _sizes(face) + _evidence(face)


def _sizes(face: Json) -> list[Row]:
    name, ours, theirs = face["name"], face["sizes"]["facepipe"], face["sizes"].get("blender", {})
    rows = [
        (name, f"GLB {key}{note}", _bytes(ours[key]), _bytes(theirs.get(key)), _over(theirs.get(key), ours[key]))
        for key, note in (("dense", " (facepipe's computed)"), ("sparse", ""), ("quantised", ""))
    ]
    errors = [(key, ours["error_mm"][key]) for key in ("sparse", "quantised")]
    return rows + [(name, f"  error it states, {key}", f"{mm:.4f} mm", "", "") for key, mm in errors if mm is not None]


def _evidence(face: Json) -> list[Row]:
    """What both files hold: figures are worth something where it is the same."""
    name, ours, theirs = face["name"], face["content"]["facepipe"], face["content"].get("blender")
    rows = [(name, f"holds {key}", f"{ours[key]:,}", f"{theirs[key]:,}" if theirs else "", "") for key in _COUNTS]
    if theirs is None:
        return rows
    unlike = face["differences"]
    rows.append(
        (name, "same mesh by mesh, target by target", "no: " + "; ".join(unlike[:2]) if unlike else "yes", "", "")
    )
    off = face["target_reach_difference_mm"]
    if off is not None:
        rows.append((name, "largest difference of a target's reach", f"{off:.6f} mm", "", ""))
    return rows


def _bytes(count: int | None) -> str:
    return "" if count is None else f"{count:,} B"


def _over(theirs: float | None, ours: float) -> str:
    return times(None if theirs is None else theirs / ours)


def import_face(kind: str, source: str, stage: str) -> Json:
    """Source to parts, parts to a saved stage."""
    from facepipe import importers
    from facepipe.stage import save_parts

    importers.importer(kind)
    baseline = peak_memory()
    start = time.perf_counter()
    parts = importers.load(kind, source).parts
    read = time.perf_counter()
    save_parts(parts, stage)
    end = time.perf_counter()
    return {
        "read_s": read - start,
        "save_s": end - read,
        "import_s": end - start,
        "baseline_bytes": baseline,
        "peak_bytes": peak_memory(),
    }


def export_face(stage: str, glb: str, variant: str) -> Json:
    """Stage to arrays, then the export call alone, several times."""
    from facepipe_gltf import Options, export

    import facepipe
    import facepipe.stage.face  # else the first open would

    options = Options(quantize=variant == "quantised", morph_normals=variant == "normals")
    baseline = peak_memory()
    start = time.perf_counter()
    face = facepipe.open(stage)
    face.parts()  # a face keeps what it has read: the export below reads nothing
    loaded = time.perf_counter()
    loaded_peak = peak_memory()
    reports = []
    times = export_times(lambda: reports.append(export(face, glb, options)))
    return times | {
        "load_s": loaded - start,
        "load_export_s": loaded - start + times["export_s"],
        "baseline_bytes": baseline,
        "loaded_bytes": loaded_peak,
        "glb_bytes": Path(glb).stat().st_size,
        "error_mm": reports[0].error_mm,
        "version": facepipe.__version__,
    }


if __name__ == "__main__":
    sys.exit(0 if is_side({"import": import_face, "export": export_face}) else main())
