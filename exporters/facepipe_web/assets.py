"""The files of a face that the page loads, and its entry in viewer.json."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe import registry
from facepipe.records import Json

if TYPE_CHECKING:
    from facepipe.parts import FaceParts


def write_assets(
    parts: FaceParts, label: str, folder: Path, url: str, pose: str = "set"
) -> tuple[Json, dict[str, Path]]:
    """Export a face into an empty folder: its entry in viewer.json, and path on the server -> file.

    :param label: what the page calls it
    :param url: folder on the server, without slashes at its ends
    :param pose: the person at rest, as the exporters take it
    :raises ExportError: a face that a format can't hold
    :raises InputError: no such pose
    """
    folder.mkdir(parents=True)
    notes = _export(parts, folder / "face.glb", pose=pose, morph_normals=True)
    if parts.sliders:
        notes += _export(parts, folder / "sliders.onnx", pose=pose, sliders=True)
    regions = _write_masks(parts, folder / "regions.bin")
    details: Json = {
        "joints": _joints(parts),
        "meshes": [{"name": mesh.name, "points": len(mesh.points)} for mesh in parts.meshes],
        "notes": list(dict.fromkeys(notes)),
        "regions": {"names": regions, "masks": f"{url}/regions.bin"} if regions else None,
    }
    (folder / "details.json").write_text(json.dumps(details), encoding="utf-8")
    entry = {
        "label": label,
        "glb": f"{url}/face.glb",
        "onnx": f"{url}/sliders.onnx" if parts.sliders else None,
        "details": f"{url}/details.json",
    }
    return entry, {f"/{url}/{file.name}": file for file in folder.iterdir()}


def given_assets(label: str, glb: Path, onnx: Path | None, url: str) -> tuple[Json, dict[str, Path]]:
    """The same of files that are there: a GLB, and the ONNX of its sliders with its sidecar."""
    files = {f"/{url}/face.glb": glb}
    if onnx is not None:
        files |= {f"/{url}/sliders.onnx": onnx, f"/{url}/sliders.onnx.json": onnx.with_name(f"{onnx.name}.json")}
    entry = {
        "label": label,
        "glb": f"{url}/face.glb",
        "onnx": None if onnx is None else f"{url}/sliders.onnx",
        "details": None,
    }
    return entry, files


def _export(parts: FaceParts, path: Path, **settings: bool | str) -> list[str]:
    """Write one file; who is at rest where that is set, and what the report warns of."""
    from facepipe.parts import HeldFace

    exporter = registry.exporter(path)
    report = exporter.export(HeldFace(parts), path, exporter.Options(**settings))
    return [*([] if report.pose == "rest" else [f"at rest: {report.pose}"]), *report.warnings]


def _joints(parts: FaceParts) -> Json | None:
    """Paths of the joints, and the axes of their coefficients: the stage's times the skeleton's scale."""
    import numpy as np

    if not parts.skeleton.joints:
        return None
    axes = parts.gltf_axes
    axes[:3, :3] *= np.cbrt(abs(np.linalg.det(np.asarray(parts.skeleton.transform)[:3, :3])))
    return {"paths": list(parts.skeleton.joints), "axes": axes.tolist()}


def _write_masks(parts: FaceParts, path: Path) -> Sequence[str]:
    """The regions' masks, a byte for each point of all meshes, region after region; their names, none without."""
    import numpy as np

    names = sorted({name for mesh in parts.meshes for name in mesh.regions})
    if names:
        rows = [
            np.concatenate([mesh.regions.get(name, np.zeros(len(mesh.points))) for mesh in parts.meshes])
            for name in names
        ]
        path.write_bytes(np.rint(255 * np.clip(rows, 0, 1)).astype(np.uint8).tobytes())
    return names
