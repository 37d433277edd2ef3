"""Clear coat, sheen and index of refraction: what engines read of them, what merging keeps, and what comes back."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from facepipe_gltf.atlas import Atlas
from facepipe_gltf.options import ENGINES
from facepipe_gltf.read import Options as ReadOptions
from facepipe_gltf.read import read
from faces import grid_mesh, replace_mesh
from gltf_builder import build, make_model
from gltf_export import Writing, writing, written
from gltf_reader import Gltf
from pxr import Usd, UsdShade
from textures import picture, textured

from facepipe.core.errors import InputError
from facepipe.heads import make
from facepipe.parts import FaceParts, Material, TextureInput
from facepipe.stage import Face
from facepipe.stage.face import open_face

__all__ = ["writing", "written"]

COAT, SHEEN, IOR = "KHR_materials_clearcoat", "KHR_materials_sheen", "KHR_materials_ior"
FUZZY = Material(name="skin", ior=1.4, sheen_color=(0.25, 0.125, 0.5), sheen_roughness=0.75)


@cache
def person() -> FaceParts:
    return make(5, textures=128)


def face(material: Material) -> FaceParts:
    mesh = replace_mesh(grid_mesh(size=4), material=material.name)
    return FaceParts(name="Face", meshes=(mesh,), materials=(material,))


def extensions(file: Gltf) -> dict[str, dict[str, Any]]:
    """Of each material by its name."""
    return {one["name"]: one.get("extensions", {}) for one in file.list("materials")}


def plain(file: Gltf) -> list[dict[str, Any]]:
    """What of its materials a reader without extensions sees."""
    return [{key: value for key, value in one.items() if key != "extensions"} for one in file.list("materials")]


def test_the_head_has_fuzz_on_its_skin_and_tears_on_the_whites_of_its_eyes(writing: Writing) -> None:
    """None is required, so that any reader shows the plain material."""
    file, _ = writing(person())
    found = extensions(file)
    assert {name for name, own in found.items() if SHEEN in own} == {"M_Face", "M_BackHead"}
    assert {name for name, own in found.items() if COAT in own} == {"M_ScleraLeft", "M_ScleraRight"}
    assert found["M_Face"][SHEEN] == found["M_BackHead"][SHEEN]  # no seam between the tiles
    (skin, cornea, tears) = (
        ((ior - 1) / (ior + 1)) ** 2 for ior in (found["M_Face"][IOR]["ior"], found["Cornea"][IOR]["ior"], 1.337)
    )
    assert (skin, cornea) == pytest.approx((0.028, 0.025), abs=5e-4)
    # a coat of glTF reflects 4 % at normal incidence
    assert 0.04 * found["M_ScleraLeft"][COAT]["clearcoatFactor"] == pytest.approx(tears, abs=1e-3)
    assert {COAT, SHEEN, IOR} <= set(file.json["extensionsUsed"])
    assert not file.json.get("extensionsRequired")


def test_a_head_without_textures_has_the_same_fuzz() -> None:
    coloured = {one.name: one for one in make(5, textures=None).materials}
    for one in person().materials:
        if one.name.startswith(("M_", "Pupil", "Cornea")):
            own = coloured[one.name]
            assert (own.sheen_color, own.sheen_roughness, own.clearcoat) == (
                one.sheen_color,
                one.sheen_roughness,
                one.clearcoat,
            )


@pytest.mark.parametrize("engine", ENGINES)
def test_an_engine_gets_what_it_reads_and_all_get_the_same_plain_material(engine: str, writing: Writing) -> None:
    parts = face(replace(FUZZY, clearcoat=0.5))
    whole, _ = writing(parts)
    file, report = writing(parts, f"{engine}.glb", engine=engine)
    reader, own = ENGINES[engine], extensions(file)["skin"]
    assert (SHEEN in own, COAT in own, IOR in own) == (reader.sheen, reader.clearcoat, True)
    lost = [line for line in report.dropped if "KHR_materials" in line]
    unread = [kind for kind, reads in ((SHEEN, reader.sheen), (COAT, reader.clearcoat)) if not reads]
    assert sorted(lost) == sorted(f"{kind} of 1 material: {reader.title} does not read it" for kind in unread)
    assert plain(file) == plain(whole)


def test_eyes_merge_into_one_material_whose_coat_is_on_the_whites_alone(writing: Writing) -> None:
    file, report = writing(person(), purpose="game", engine="unreal")
    assert "8 meshes and 13 materials as 4 and 7" in report.chosen
    found = extensions(file)
    coat = found["Eyes"][COAT]
    wet = file.pixels(coat["clearcoatTexture"])[..., 0] / 255 * coat["clearcoatFactor"]
    dry, half = (np.abs(wet - value) < 0.02 for value in (0.0, 0.5))
    assert (dry | half).mean() > 0.95  # all but the edges of cells
    assert dry.any()
    assert half.any()
    assert COAT not in found["Cornea"]
    assert found["M_Face"][SHEEN] == found["M_BackHead"][SHEEN]


def test_an_atlas_holds_coats_as_they_are() -> None:
    mask = np.zeros((64, 64, 3), np.uint8)
    mask[:, 32:] = 255
    drawn = textured(picture("wet.png", mask), "r", scale=(0.8,) * 4)
    materials = [Material(name="a", clearcoat=drawn), Material(name="b", clearcoat=0.25)]
    whole = Atlas(materials, "st").material("both").clearcoat
    assert isinstance(whole, TextureInput)
    alike = Atlas([replace(one, clearcoat=0.25) for one in materials], "st").material("both")
    assert alike.clearcoat == 0.25


@pytest.mark.parametrize("material", [FUZZY, replace(FUZZY, clearcoat=0.5, clearcoat_roughness=0.25)])
def test_sheen_comes_back_from_a_stage_and_from_a_file(material: Material, tmp_path: Path, writing: Writing) -> None:
    """From a file of another tool, too: it has no record of ours."""
    Face.from_parts(face(material)).save(tmp_path / "face.usda")
    (staged,) = open_face(tmp_path / "face.usda").parts().materials
    file, report = writing(face(material), purpose="game", engine="unreal")
    assert "extras" not in file.json
    (back,) = read(report.path, ReadOptions()).parts.materials
    for one in (staged, back):
        for field in ("ior", "sheen_color", "sheen_roughness", "clearcoat", "clearcoat_roughness"):
            np.testing.assert_allclose(getattr(one, field), getattr(material, field), atol=1e-6, err_msg=field)


def test_unlit_materials_have_no_sheen(writing: Writing) -> None:
    file, _ = writing(face(replace(FUZZY, ior=1.5, unlit=True)))
    assert SHEEN not in extensions(file)["skin"]


def test_pictures_of_a_sheen_are_named_and_its_factors_kept(tmp_path: Path) -> None:
    builder = build(make_model())
    sheen = {"sheenColorFactor": [0.5, 0.25, 0.0], "sheenColorTexture": {"index": 0}}
    builder.root["materials"][0]["extensions"] = {SHEEN: sheen}
    (tmp_path / "fuzzy.glb").write_bytes(builder.glb())
    imported = read(tmp_path / "fuzzy.glb", ReadOptions())
    assert any("its pictures are left out" in line for line in imported.warnings)
    assert imported.parts.materials[0].sheen_color == (0.5, 0.25, 0.0)


@pytest.mark.parametrize("value", ["red", 1.0])
def test_a_damaged_sheen_is_one_line_that_names_the_material(value: object, tmp_path: Path) -> None:
    Face.from_parts(face(FUZZY)).save(tmp_path / "face.usda")
    stage = Usd.Stage.Open(str(tmp_path / "face.usda"))
    prim = next(prim for prim in stage.Traverse() if prim.IsA(UsdShade.Material))
    prim.SetCustomDataByKey("facepipe:sheenColor", value)
    stage.Save()
    with pytest.raises(InputError, match=r"skin.*can't be read"):
        open_face(tmp_path / "face.usda").parts()
