"""What inspect says that a glTF file is made of: every byte once, counts as glTF's own JSON has them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import gltf_reader
import pytest
import small_head
from facepipe_gltf import Options, export
from facepipe_gltf.read import contents
from gltf_export import Parts

import facepipe
from facepipe.core.errors import InputError
from facepipe.stage import save_parts

DRACO = Path(__file__).with_name("draco")


def accounted(found: dict[str, Any]) -> int:
    """All bytes that have a place, with those that have none."""
    parts = sum(part["geometry"] + part["target_bytes"] for part in found["parts"].values())
    return parts + sum(found[name] for name in ("textures", "animations", "skins", "json", "other"))


@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
def test_every_byte_has_one_place(suffix: str, tmp_path: Path) -> None:
    report = export(Parts(small_head.make()), tmp_path / f"head{suffix}", Options(animations=True))
    found = contents(report.path)
    assert found["bytes"] == report.bytes == sum(file.stat().st_size for file in report.files)
    assert accounted(found) == found["bytes"]
    assert 0 < found["other"] < 0.05 * found["bytes"]  # the record of what glTF has no place for


def test_counts_are_those_of_the_json(tmp_path: Path) -> None:
    report = export(Parts(small_head.make()), tmp_path / "head.glb")
    found, json_of = contents(report.path), gltf_reader.read(report.path).json
    accessors = json_of["accessors"]
    for mesh in json_of["meshes"]:
        part, primitives = found["parts"][mesh["name"]], mesh["primitives"]
        assert part["primitives"] == len(primitives)
        assert part["targets"] == len(mesh.get("extras", {}).get("targetNames", []))
        assert part["vertices"] == sum(accessors[one["attributes"]["POSITION"]]["count"] for one in primitives)
        assert part["triangles"] == sum(accessors[one["indices"]]["count"] for one in primitives) // 3
    assert found["materials"] == len(json_of["materials"])
    assert found["images"] == len(json_of.get("images", []))
    assert {"vertices", "triangles", "primitives", "targets"} <= report.counts.keys()
    for name in ("vertices", "triangles", "primitives", "targets"):
        assert found[name] == report.counts[name] == sum(part[name] for part in found["parts"].values())


def test_bytes_of_targets_are_those_that_go_with_them(tmp_path: Path) -> None:
    face = Parts(small_head.make())
    whole = contents(export(face, tmp_path / "whole.glb").path)
    without = contents(export(face, tmp_path / "without.glb", Options(shapes="jawOpen")).path)
    for name, part in whole["parts"].items():
        other = without["parts"][name]
        assert part["geometry"] == other["geometry"]
        assert part["target_bytes"] >= other["target_bytes"]
    targets = [sum(part["target_bytes"] for part in one["parts"].values()) for one in (whole, without)]
    same = {name: whole[name] - without[name] for name in ("json", "other")}
    assert targets[0] - targets[1] == whole["bytes"] - without["bytes"] - sum(same.values())


def test_draco_counts_for_the_geometry_of_its_mesh() -> None:
    found = contents(DRACO / "parts.glb")
    assert accounted(found) == found["bytes"]
    assert all(part["geometry"] > 0 for part in found["parts"].values())


def test_inspect_prints_it_of_files_and_not_of_stages(tmp_path: Path) -> None:
    stage, glb = tmp_path / "head.usdc", tmp_path / "head.glb"
    save_parts(small_head.make(), stage)
    facepipe.export(stage, glb)
    report = facepipe.inspect(glb)
    assert report.file == contents(glb)
    assert f"{glb.stat().st_size / 1000:,.0f} kB, " in report.as_text(glb)
    assert facepipe.inspect(stage).file is None


def test_references_to_nothing_are_refused(tmp_path: Path) -> None:
    broken = {
        "asset": {"version": "2.0"},
        "accessors": [{"componentType": 5126, "type": "VEC3", "count": 3, "bufferView": 4}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
    }
    file = tmp_path / "broken.gltf"
    file.write_text(json.dumps(broken), encoding="utf-8")
    with pytest.raises(InputError, match=r"accessors\[0\].bufferView: 4, but there are 0 bufferViews"):
        contents(file)


def test_inspect_counts_what_it_can_of_files_that_lack_something(tmp_path: Path) -> None:
    """A missing picture has no bytes; where a clip leads to nothing, a warning says so."""
    path = export(Parts(small_head.make()), tmp_path / "head.gltf", Options(animations=True)).path
    json_of = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps(json_of | {"images": [{"uri": "gone.png"}]}), encoding="utf-8")
    report = facepipe.inspect(path)
    assert report.file is not None
    assert report.file["images"] == 1
    assert report.file["textures"] == 0
    json_of["animations"].append({"channels": [], "samplers": [{"input": 1_000_000, "output": 0}]})
    path.write_text(json.dumps(json_of), encoding="utf-8")
    report = facepipe.inspect(path)
    assert report.file is None
    assert any("bytes are not counted: " in line for line in report.warnings)
