"""KHR_materials_variants: a variant set on the stage, by which USD itself shows each, and variants again in exports."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from command_line import Capsys, done, failed, run
from facepipe_gltf import read as gltf
from gltf_builder import Builder
from node import run_node, validate
from pxr import Sdf, Usd
from variant_files import (
    EXPECTED,
    EXTENSION,
    NAMES,
    PRIMITIVES,
    by_primitive,
    called,
    in_glb,
    shown_on,
    variants_on,
    with_variants,
)

import facepipe
from facepipe.core.errors import InputError, SchemaError
from facepipe.parts import Material
from facepipe.stage import open_face, save_parts

Shown = dict[str | None, list[str]]


def read(folder: Path, builder: Builder) -> Any:
    (folder / "face.glb").write_bytes(builder.glb())
    return gltf.read(folder / "face.glb", gltf.Options())


def imported(folder: Path, capsys: Capsys, suffix: str = ".usda") -> Path:
    (folder / "face.glb").write_bytes(with_variants().glb())
    path = folder / f"face{suffix}"
    done(capsys, "import", "gltf", folder / "face.glb", "-o", path, quiet=False)
    return path


def shown(path: Path) -> Shown:
    """What the primitives show in each variant of a stage."""
    stage = Usd.Stage.Open(str(path))
    return {name: by_primitive(stage, own) for name, own in variants_on(stage).items()}


def test_an_import_shows_what_the_file_shows(tmp_path: Path, capsys: Capsys) -> None:
    (tmp_path / "face.glb").write_bytes(with_variants().glb())
    code, _, said = run(capsys, "import", "gltf", tmp_path / "face.glb", "-o", tmp_path / "face.usda")
    assert code == 0
    assert (
        "materials: 5 variants, Light, so dark / very, 夜 の色, 2-tone ..., as the variant set shadingVariant" in said
    )
    assert shown(tmp_path / "face.usda") == EXPECTED
    identifiers = variants_on(Usd.Stage.Open(str(tmp_path / "face.usda")))
    assert identifiers == {
        None: "default",
        "Light": "Light",
        "so dark / very": "so_dark___very",
        "夜 の色": "夜_の色",
        "2-tone": "2-tone",
        "default": "default_2",
    }


def test_an_export_has_them_again(tmp_path: Path, capsys: Capsys) -> None:
    done(capsys, "export", imported(tmp_path, capsys), "-o", tmp_path / "out.glb")
    assert in_glb(tmp_path / "out.glb") == in_glb(tmp_path / "face.glb") == EXPECTED
    again = gltf.read(tmp_path / "out.glb", gltf.Options())
    assert again.warnings == ()
    assert again.parts.materials == facepipe.open(tmp_path / "face.usda").parts().materials
    done(capsys, "import", "gltf", tmp_path / "out.glb", "-o", tmp_path / "again.usda")
    done(capsys, "export", tmp_path / "again.usda", "-o", tmp_path / "again.glb")
    assert (tmp_path / "again.glb").read_bytes() == (tmp_path / "out.glb").read_bytes()


@pytest.mark.parametrize("way", ["flat", "usdz", "usd again", "an override", "a layer above, flat"])
def test_every_way_on_keeps_them(way: str, tmp_path: Path, capsys: Capsys) -> None:
    face = imported(tmp_path, capsys)
    result = tmp_path / ("end.usdz" if way == "usdz" else "end.usdc")
    if way in ("usd again", "usdz"):
        done(capsys, "import", "usd", face, "-o", result, quiet=False)
    else:
        with facepipe.open(face).deriving(result, flatten="flat" in way):
            pass
    assert shown(result) == EXPECTED
    done(capsys, "export", result, "-o", tmp_path / "out.glb")
    assert in_glb(tmp_path / "out.glb") == EXPECTED


@pytest.mark.parametrize("suffix", [".usda", ".usdz"])
def test_levels_of_detail_have_them_too(suffix: str, tmp_path: Path, capsys: Capsys) -> None:
    face, levels, flat = imported(tmp_path, capsys), tmp_path / "lods.usda", tmp_path / f"flat{suffix}"
    facepipe.lod(face, out=levels, triangles=(80,))
    with facepipe.open(levels).deriving(flat, flatten=True):
        pass
    for path in (levels, flat):
        stage = Usd.Stage.Open(str(path))
        variants = variants_on(stage)
        assert {name: by_primitive(stage, own) for name, own in variants.items()} == EXPECTED
        stage.GetDefaultPrim().GetVariantSet("lod").SetVariantSelection("lod1")
        assert {name: by_primitive(stage, own) for name, own in variants.items()} == EXPECTED
        assert all("lod1" in one for one in shown_on(stage, "default"))
        face = open_face(path)
        assert face.at_level(1).parts().materials == face.parts().materials
    report = facepipe.export(open_face(flat), tmp_path / "out.glb", lods=True)
    assert not report.dropped
    assert in_glb(tmp_path / "out.glb") == EXPECTED


def test_what_is_selected_is_the_default(tmp_path: Path, capsys: Capsys) -> None:
    face = imported(tmp_path, capsys)
    layer = Sdf.Layer.FindOrOpen(str(face))
    layer.GetPrimAtPath(layer.rootPrims[0].path).variantSelections["shadingVariant"] = "so_dark___very"
    layer.Save()
    done(capsys, "export", face, "-o", tmp_path / "out.glb")
    found = in_glb(tmp_path / "out.glb")
    assert found[None] == found["so dark / very"] == EXPECTED["so dark / very"]
    # the file's own materials and its variant `default` share a name
    others = {name: row for name, row in found.items() if name is not None and not name.startswith("default")}
    assert others == {name: EXPECTED[name] for name in NAMES if name != "default"}
    assert sorted(found[name] for name in found if str(name).startswith("default")) == sorted(
        [EXPECTED[None], EXPECTED["default"]]
    )


def test_a_foreign_reader_takes_one_as_the_face(tmp_path: Path, capsys: Capsys) -> None:
    face = imported(tmp_path, capsys)
    done(capsys, "import", "usd", face, "--variant", "shadingVariant=Light", "-o", tmp_path / "two.usda", quiet=False)
    assert shown(tmp_path / "two.usda")[None] == EXPECTED["Light"]


def test_textures_of_variants_come_along(tmp_path: Path, capsys: Capsys) -> None:
    face = facepipe.open(imported(tmp_path, capsys)).parts()
    red = next(one for one in face.materials if one.textured)
    assert red.name == "red"
    used = red.textured["diffuse_color"]
    assert used.texture.data
    # the transform of the texture is in the UVs
    sets = {one.name: one for one in face.meshes[0].uv_sets}
    assert used.uv_transform == (1, 0, 0, 0, 1, 0)
    assert used.uv_set in sets


def test_the_order_of_primitives_does_not_matter(tmp_path: Path) -> None:
    for primitives in (PRIMITIVES, PRIMITIVES[::-1]):
        parts = read(tmp_path, with_variants(primitives=primitives)).parts
        assert len(parts.materials) == 3 + 3 + 1  # skin is three
        assert sum((one.label or one.name) == "skin" for one in parts.materials) == 3


def spoilt(**changes: Any) -> Builder:
    builder = with_variants()
    said = builder.root["extensions"][EXTENSION]
    mapping = builder.root["meshes"][0]["primitives"][0]["extensions"][EXTENSION]
    for key, value in changes.items():
        (said if key == "variants" else mapping)[key] = value
    return builder


def named(*names: Any) -> list[dict[str, Any]]:
    return [{"name": name} for name in names]


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"mappings": [{"material": 99, "variants": [0]}]}, "mappings[0].material: 99"),
        ({"mappings": [{"material": 1, "variants": [7]}]}, "variants[0]: 7, but there are 5 variants: left out"),
        ({"mappings": [{"material": 1, "variants": [-1]}]}, "variants[0]"),
        ({"mappings": [{"material": 1, "variants": "0"}]}, "expected an array: left out"),
        ({"mappings": 3}, "expected an array: left out"),
        ({"mappings": [{"material": 1, "variants": [0]}, {"material": 2, "variants": [0]}]}, "another material here"),
        ({"mappings": [{"material": 1, "variants": [9 + n]} for n in range(40)]}, "36 further names and mappings"),
        ({"variants": named(*NAMES[:4], 5)}, "expected text: left out"),
        ({"variants": named(*NAMES[:4], "Light")}, "2 variants called 'Light'"),
        ({"variants": named(*NAMES[:4], "")}, "1 variant without a name"),
        ({"variants": named(*NAMES[:4], "a\0b")}, "NUL"),
        ({"variants": [*named(*NAMES), 7]}, "expected an object"),
        ({"variants": {}}, "expected an array: variants left out"),
        ({"variants": named(*map(str, range(3000)))}, "3000 variants, expected at most 256: variants left out"),
    ],
)
def test_what_can_not_be_is_named(changes: dict[str, Any], line: str, tmp_path: Path) -> None:
    result = read(tmp_path, spoilt(**changes))
    assert any(line in one for one in result.warnings), result.warnings
    assert len(result.warnings) < 8
    save_parts(result.parts, tmp_path / "face.usda")
    names = open_face(tmp_path / "face.usda").parts().variants
    assert len(names) == len(set(names))


def test_variants_that_change_nothing_are_named(tmp_path: Path) -> None:
    result = read(tmp_path, with_variants(primitives=[("skin", {}), ("cloth", {"Light": "cloth"})]))
    assert result.parts.variants == ()
    assert "materials: 5 variants left out: no triangles have another material in them" in result.warnings


def test_variants_of_too_many_meshes_are_named(tmp_path: Path) -> None:
    names = [str(number) for number in range(256)]
    builder = with_variants(names, [("skin", {"7": "red"})])
    shown = [builder.add("nodes", {"mesh": 0, "name": str(number)}) for number in range(129)]
    builder.root["scenes"][0]["nodes"] = shown
    result = read(tmp_path, builder)
    assert (len(result.parts.meshes), result.parts.variants) == (129, ())
    line = "256 variants of materials of 129 meshes and parts of meshes, expected at most 254 variants of so many"
    assert f"materials: {line}: left out" in result.warnings


def test_more_variants_than_a_face_can_have_are_refused_in_a_line(tmp_path: Path) -> None:
    parts = read(tmp_path, with_variants()).parts
    row = {str(number): "pale" for number in range(300)}
    materials = tuple(Material(name=one.name, variants=row if one.name == "skin" else {}) for one in parts.materials)
    with pytest.raises(InputError, match="300 variants of materials, expected at most 256"):
        save_parts(replace(parts, materials=materials), tmp_path / "face.usda")


def test_a_variant_of_no_material_is_refused(tmp_path: Path, capsys: Capsys) -> None:
    parts = read(tmp_path, with_variants()).parts
    kept = tuple(one for one in parts.materials if one.name != "red")
    with pytest.raises(InputError, match="no material 'red', which its variant"):
        save_parts(replace(parts, materials=kept), tmp_path / "no.usda")
    face = imported(tmp_path, capsys)
    layer = Sdf.Layer.FindOrOpen(str(face))
    place = Sdf.Path("/Face{shadingVariant=Light}")
    bound = [one for one in _relationships(layer.GetPrimAtPath(place)) if one.name == "material:binding"]
    bound[0].targetPathList.explicitItems = [Sdf.Path("/Face/Materials/gone")]
    layer.Save()
    with pytest.raises(SchemaError, match=r"face.usda.* -> <.*>: shows <.*>, and no material in the variant Light"):
        open_face(face).parts()
    assert "in the variant Light" in failed(capsys, "export", face, "-o", tmp_path / "out.glb", folder=tmp_path)


def _relationships(spec: Sdf.PrimSpec) -> Sequence[Any]:
    return [*spec.relationships, *(one for child in spec.nameChildren for one in _relationships(child))]


def test_materials_that_change_otherwise_elsewhere_are_refused(tmp_path: Path, capsys: Capsys) -> None:
    """As a stage has it where somebody bound one of two meshes anew: each needs a material of its own."""
    face = imported(tmp_path, capsys)
    stage = Usd.Stage.Open(str(face))
    layer = stage.GetRootLayer()
    found = _relationships(layer.GetPrimAtPath("/Face{shadingVariant=default}"))
    found[1].targetPathList.explicitItems = list(found[0].targetPathList.explicitItems)
    layer.Save()
    with pytest.raises(SchemaError, match="changes with variants otherwise than on"):
        open_face(face).parts()
    done(capsys, "import", "usd", face, "-o", tmp_path / "two.usda", quiet=False)


@pytest.mark.slow
def test_readers_of_games_have_them(tmp_path: Path, capsys: Capsys) -> None:
    """Babylon.js keeps what an earlier variant showed where a later one says nothing of a primitive."""
    done(capsys, "export", imported(tmp_path, capsys), "-o", tmp_path / "out.glb")
    report = validate([tmp_path / "out.glb"])[tmp_path / "out.glb"]["issues"]
    assert (report["numErrors"], report["numWarnings"]) == (0, 0), report["messages"]
    there = run_node("babylon_variants.mjs", [str(tmp_path / "out.glb")])
    assert {name or None: [*map(called, row)] for name, row in there.items()} == EXPECTED
