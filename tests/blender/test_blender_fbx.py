"""Blender writes a face as FBX: read again, it stands and plays as Blender shows it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from blender_python import blender, needs_blender
from fbx_posed import posed

from facepipe.cli import main
from facepipe.importers import load

pytestmark = [needs_blender, pytest.mark.slow]
pytest.importorskip("wasmtime")

WAYS: dict[str, dict[str, Any]] = {
    "as Blender proposes": {},
    "units in the file, pictures too": {
        "apply_scale_options": "FBX_SCALE_UNITS",
        "path_mode": "COPY",
        "embed_textures": True,
    },
    "metres, Z up": {
        "apply_scale_options": "FBX_SCALE_ALL",
        "axis_forward": "Y",
        "axis_up": "Z",
        "add_leaf_bones": False,
    },
    "X up": {"axis_forward": "Z", "axis_up": "X"},
}


@pytest.fixture(scope="module")
def head(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("head")
    assert main(["sample", str(folder / "head.usda")]) == 0
    assert main(["export", str(folder / "head.usda"), "-o", str(folder / "head.glb")]) == 0
    return folder / "head.glb"


@pytest.mark.parametrize("way", WAYS)
def test_a_head_stands_and_plays_as_in_blender(way: str, head: Path, tmp_path: Path) -> None:
    file = tmp_path / "head.fbx"
    truth, _ = blender("fbx_export.py", head, file, WAYS[way], answer=tmp_path / "truth.npz")
    parts = load("fbx", file).parts
    original = load("gltf", head).parts
    assert parts.up_axis == ("Z" if "Z up" in way else "Y")
    shown = {mesh.name: mesh for mesh in parts.meshes}
    for mesh in original.meshes:
        names = {one.label or one.name for one in shown[mesh.name].blendshapes}
        assert names == {name for one in mesh.blendshapes for name, _, _ in one.sculpts}  # Blender has no inbetweens
    named = {*original.skeleton.names}
    assert named <= {*parts.skeleton.names}
    clip = next(one.name for one in parts.animations if one.times is not None)
    frames = truth["frames"].tolist()
    for frame in frames:
        points, start = posed(parts, clip, (frame - frames[0]) / 30) * parts.meters_per_unit, 0
        for mesh in parts.meshes:
            own = points[start : start + len(mesh.points)]
            own = own if parts.up_axis == "Y" else np.stack([own[:, 0], own[:, 2], -own[:, 1]], axis=1)
            assert np.abs(own - truth[f"points {frame} {mesh.name}"]).max() < 5e-7  # metres: float32 at a head's size
            start += len(mesh.points)
    textured = sum(len(material.textured) for material in parts.materials)
    assert (textured > 5) == ("pictures" in way)
