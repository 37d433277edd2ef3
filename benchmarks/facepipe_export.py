"""Child of export_gltf.py, facepipe's side: imports a face, or exports a stage, and reports times and memory.

usage: facepipe_export.py import KIND SOURCE STAGE REPORT
       facepipe_export.py export STAGE GLB sparse|quantised|normals REPORT
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

from children import Json, export_times, peak_memory, write_report


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


def main(arguments: list[str]) -> None:
    """Run the verb, report to the last argument."""
    verb, *rest, report = arguments
    write_report(report, (import_face if verb == "import" else export_face)(*rest))


if __name__ == "__main__":
    main(sys.argv[1:])
