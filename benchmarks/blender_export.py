"""Child of export_gltf.py, Blender's side; runs in an environment of its own that has bpy and no facepipe.

usage: blender_export.py STAGE GLB matched|normals|dense|defaults REPORT
       blender_export.py --check REPORT
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

from children import Json, export_times, peak_memory, write_report

# What facepipe's file holds: triangles, UVs, materials, skin with 4 influences, all shapes as sparse targets; no
# animations, no tangents and no normals in targets, since the stage has no normal offsets.
_MATCHED: Json = {
    "export_format": "GLB",
    "export_texcoords": True,
    "export_normals": True,
    "export_tangents": False,
    "export_materials": "EXPORT",
    "export_skins": True,
    "export_all_influences": False,
    "export_influence_nb": 4,
    "export_morph": True,
    "export_morph_normal": False,
    "export_morph_tangent": False,
    "export_try_sparse_sk": True,
    "export_animations": False,
    "export_draco_mesh_compression_enable": False,
}
_VARIANTS: dict[str, Json] = {
    "matched": _MATCHED,
    "normals": {**_MATCHED, "export_morph_normal": True},
    "dense": {**_MATCHED, "export_try_sparse_sk": False},
    "defaults": {"export_format": "GLB"},
}


def blender() -> Any:
    """The module bpy."""
    import bpy  # type: ignore[import-not-found]

    return bpy


def export_stage(stage: str, glb: str, variant: str) -> Json:
    """Stage to a scene, then the export call alone, several times."""
    bpy = blender()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    baseline = peak_memory()
    start = time.perf_counter()
    bpy.ops.wm.usd_import(filepath=stage)
    loaded = time.perf_counter()
    loaded_peak = peak_memory()
    options = {"filepath": glb, "check_existing": False, **_VARIANTS[variant]}
    times = export_times(lambda: bpy.ops.export_scene.gltf(**options))
    return times | {
        "load_s": loaded - start,
        "load_export_s": loaded - start + times["export_s"],
        "baseline_bytes": baseline,
        "loaded_bytes": loaded_peak,
        "glb_bytes": Path(glb).stat().st_size,
        "version": bpy.app.version_string,
    }


def main(arguments: list[str]) -> None:
    """Export, or only see that bpy is there; report to the last argument."""
    *rest, report = arguments
    if rest == ["--check"]:
        write_report(report, {"version": blender().app.version_string})
    else:
        write_report(report, export_stage(*rest))


if __name__ == "__main__":
    main(sys.argv[1:])
