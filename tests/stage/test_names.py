"""Names of a source, whatever they are: kept through the stage, and written back to the byte."""

import json
from pathlib import Path

import facepipe_gltf
import gltf_reader
import pytest
from hostile_names import HOSTILE, hostile_document, names_of
from pxr import Sdf, Usd, UsdGeom, UsdSkel

import facepipe
from facepipe.checks import validate
from facepipe.core.names import identifier
from facepipe.importers import load
from facepipe.stage import Face, save_parts


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("names") / "source.glb"
    path.write_bytes(hostile_document().glb())
    return path


@pytest.mark.parametrize("suffix", [".usda", ".usdc"])
def test_hostile_names_come_through_a_stage_to_the_byte(source: Path, tmp_path: Path, suffix: str) -> None:
    stage, again = tmp_path / f"face{suffix}", tmp_path / "again.glb"
    save_parts(load("gltf", source).parts, stage)
    face = facepipe.open(stage)
    facepipe_gltf.export(face, again, facepipe_gltf.Options(animations=True))
    before, after = names_of(gltf_reader.read(source).json), names_of(gltf_reader.read(again).json)
    assert len(HOSTILE) == 50
    assert after == before
    assert [one for one in facepipe_gltf.validate(again) if one.severity == "error"] == []


def test_a_plain_reader_finds_the_topology_and_the_names(source: Path, tmp_path: Path) -> None:
    """Without facepipe: UsdSkel's own topology has the parents of the source, and prims hold their sources' names."""
    save_parts(load("gltf", source).parts, tmp_path / "face.usda")
    stage = Usd.Stage.Open(str(tmp_path / "face.usda"))
    (skeleton,) = (UsdSkel.Skeleton(prim) for prim in stage.Traverse() if prim.IsA(UsdSkel.Skeleton))
    joints = skeleton.GetJointsAttr().Get()
    assert all(Sdf.Path.IsValidPathString(str(joint)) for joint in joints)
    topology = UsdSkel.Topology(joints)
    assert topology.Validate()[0]
    names = names_of(gltf_reader.read(source).json)
    found = zip(skeleton.GetJointNamesAttr().Get(), topology.GetParentIndices(), strict=True)
    assert [(str(name), parent) for name, parent in found] == names["joints"]
    meshes = [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]
    shown = [prim.GetDisplayName() if prim.HasAuthoredDisplayName() else prim.GetName() for prim in meshes]
    assert shown == names["mesh nodes"]
    assert "あ" in {str(prim.GetName()) for prim in meshes}  # UTF-8 identifiers are prims' own names
    assert len(set(UsdSkel.BindingAPI(meshes[0]).GetBlendShapesAttr().Get())) == len(HOSTILE)


def test_names_come_through_twice_and_through_an_edit(source: Path, tmp_path: Path) -> None:
    """Stage -> arrays -> stage changes no name, and an override layer shows those of its source."""
    first = load("gltf", source).parts
    face = Face.from_parts(first)
    again = Face.from_parts(face.parts()).parts()
    for one in ("meshes", "materials", "animations"):
        assert [(x.name, x.label) for x in getattr(again, one)] == [(x.name, x.label) for x in getattr(first, one)]
    assert [x.name for x in again.meshes[0].blendshapes] == [x.name for x in first.meshes[0].blendshapes]
    assert again.skeleton.names == first.skeleton.names
    save_parts(first, tmp_path / "face.usdc")
    with facepipe.open(tmp_path / "face.usdc").deriving(tmp_path / "over.usda") as derived:
        derived.mesh_prim("DEF-spine.001").GetAttribute("doubleSided").Set(True)
    over = facepipe.open(tmp_path / "over.usda")
    assert [mesh.name for mesh in over.meshes] == [mesh.name for mesh in first.meshes]
    assert over.shapes == face.shapes


def test_names_that_no_identifier_holds_are_names_all_the_same(source: Path, tmp_path: Path) -> None:
    save_parts(load("gltf", source).parts, tmp_path / "face.usda")
    face = facepipe.open(tmp_path / "face.usda")
    assert {"あ", "mixamorig:Hips", "Idle Loop|baked", "Fcl_ALL.Joy"} <= {*face.shapes}
    moved = face.evaluate({"Idle Loop|baked": 1.0}) - face.evaluate()
    assert moved.max() == pytest.approx(0.01, abs=1e-7)
    assert face.sample("Fcl_ALL.Joy", 1)[1] == {}
    assert all(identifier(name) == str(Sdf.Path(f"/{identifier(name)}").name) for name in HOSTILE)
    assert [one for one in validate(tmp_path / "face.usda") if "name" in str(one)] == []


def test_a_name_with_nul_is_refused(tmp_path: Path) -> None:
    builder = hostile_document()
    builder.root["animations"][3]["name"] = "a\0b"
    (tmp_path / "nul.glb").write_bytes(builder.glb())
    with pytest.raises(facepipe.core.errors.InputError, match="NUL"):
        load("gltf", tmp_path / "nul.glb")


def test_identifiers_hold_in_usd() -> None:
    """Every character that Python takes for part of an identifier is one for USD too."""
    every = (chr(code) for code in range(0x20, 0x20000) if not 0xD800 <= code < 0xE000)
    assert [one for one in every if not Sdf.Path.IsValidIdentifier(identifier(f"a{one}"))] == []
    assert json.loads(json.dumps(identifier("👩 x"))) == "__x"
