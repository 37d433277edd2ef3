"""Big arrays of a .usda stand in a file beside it, and nobody who reads the stage sees a difference."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from command_line import Capsys, failed
from faces import tiny_face
from pxr import Sdf, Usd, Vt

import facepipe
from facepipe.core.errors import InputError
from facepipe.heads.assembly import make
from facepipe.parts import FaceParts
from facepipe.stage.author import save_parts
from facepipe.stage.files import open_stage, save_layer
from facepipe.stage.recipes import file_recipe, source_digest

TEXT = 1_000_000  # bytes; numbers of the head in the box are 40 MB of text


@pytest.fixture(scope="module")
def head() -> FaceParts:
    return make()


@pytest.fixture
def file(head: FaceParts, tmp_path: Path) -> Path:
    save_parts(head, tmp_path / "a.usda")
    return tmp_path / "a.usda"


def test_a_head_as_text_is_the_head(head: FaceParts, file: Path) -> None:
    assert sorted(one.name for one in file.parent.iterdir()) == ["a.usda", "a_arrays.usdc"]
    assert file.stat().st_size < TEXT
    save_parts(head, file.with_suffix(".usdc"))
    assert not (file.parent / "a_arrays_arrays.usdc").exists()
    text, whole = (facepipe.open(file.with_suffix(suffix)).parts() for suffix in (".usda", ".usdc"))
    assert repr(text) == repr(whole)
    for one, other in zip(text.meshes, whole.meshes, strict=True):
        assert np.array_equal(one.points, other.points)
        assert len(one.blendshapes) == len(other.blendshapes)
        for shape, same in zip(one.blendshapes, other.blendshapes, strict=True):
            assert np.array_equal(shape.offsets, same.offsets)


def test_small_faces_stay_one_file(tmp_path: Path) -> None:
    save_parts(tiny_face(), tmp_path / "a.usda")
    assert [one.name for one in tmp_path.iterdir()] == ["a.usda"]


def test_every_run_writes_the_same_bytes(head: FaceParts, file: Path, tmp_path: Path) -> None:
    other = tmp_path / "other" / "a.usda"
    other.parent.mkdir()
    save_parts(head, other)
    for name in ("a.usda", "a_arrays.usdc"):
        assert (file.parent / name).read_bytes() == (other.parent / name).read_bytes()


def test_values_in_variants_and_over_time_are_those_of_the_layer(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    layer = Sdf.Layer.CreateAnonymous(".usda")
    layer.timeCodesPerSecond = 30
    root = Sdf.CreatePrimInLayer(layer, "/A")
    root.specifier = Sdf.SpecifierDef
    moving = Sdf.AttributeSpec(root, "moving", Sdf.ValueTypeNames.FloatArray, Sdf.VariabilityVarying)
    for code in (1.0, 2.5):
        layer.SetTimeSample(moving.path, code, Vt.FloatArray.FromNumpy(rng.random(200_000, np.float32)))
    variants = Sdf.VariantSetSpec(root, "level")
    root.variantSetNameList.prependedItems = ["level"]
    for name in ("fine", "coarse"):
        prim = Sdf.VariantSpec(variants, name).primSpec
        own = Sdf.AttributeSpec(prim, "own", Sdf.ValueTypeNames.FloatArray)
        own.default = Vt.FloatArray.FromNumpy(rng.random(100_000, np.float32))
        child = Sdf.PrimSpec(prim, "B", Sdf.SpecifierDef, "Mesh")
        for attribute, kind in (("points", Sdf.ValueTypeNames.Float3Array), ("few", Sdf.ValueTypeNames.Float3Array)):
            spec = Sdf.AttributeSpec(child, attribute, kind, Sdf.VariabilityUniform, declaresCustom=True)
            count = 100_000 if attribute == "points" else 3
            spec.default = Vt.Vec3fArray.FromNumpy(rng.random((count, 3), np.float32))
    root.variantSelections["level"] = "fine"
    save_layer(layer, tmp_path / "a.usda")
    text, arrays = (Sdf.Layer.FindOrOpen(str(tmp_path / name)) for name in ("a.usda", "a_arrays.usdc"))
    assert (tmp_path / "a.usda").stat().st_size < 10_000
    few = Sdf.Path("/A{level=fine}B.few")
    assert text.GetAttributeAtPath(few).HasDefaultValue()
    assert not arrays.GetAttributeAtPath(few)
    for name in ("coarse", "fine"):
        found, wanted = (Usd.Stage.Open(one) for one in (text, layer))
        for stage in (found, wanted):
            stage.GetPrimAtPath("/A").GetVariantSet("level").SetVariantSelection(name)
        for path in ("/A.own", "/A/B.points", "/A/B.few"):
            one, other = (stage.GetAttributeAtPath(path) for stage in (found, wanted))
            assert one.Get() == other.Get()
            assert (one.GetVariability(), one.IsCustom()) == (other.GetVariability(), other.IsCustom())
        one, other = (stage.GetAttributeAtPath("/A.moving") for stage in (found, wanted))
        assert one.GetTimeSamples() == other.GetTimeSamples() == [1.0, 2.5]
        assert all(one.Get(code) == other.Get(code) for code in (1.0, 2.5))


def test_missing_arrays_are_one_line_that_names_them(file: Path, capsys: Capsys) -> None:
    facepipe.sliders(file, out=file.with_name("over.usda"), values={"smile": 1.0})
    (file.parent / "a_arrays.usdc").unlink()
    for verb in ("inspect", "validate"):
        for name in ("a.usda", "over.usda"):
            said = failed(capsys, verb, file.with_name(name), folder=file.parent)
            assert said.count("\n") == 1
            assert "a.usda: no ./a_arrays.usdc beside it, where its arrays are" in said


def test_another_file_in_the_place_of_arrays_is_kept(head: FaceParts, tmp_path: Path, capsys: Capsys) -> None:
    other = tmp_path / "a_arrays.usdc"
    save_parts(tiny_face(), other)
    before = other.read_bytes()
    with pytest.raises(InputError, match=r"a_arrays\.usdc: does not hold the arrays of a\.usda"):
        save_parts(head, tmp_path / "a.usda")
    said = failed(capsys, "sample", tmp_path / "a.usda", "--force", folder=tmp_path)
    assert "does not hold the arrays of a.usda" in said
    assert other.read_bytes() == before
    assert [one.name for one in tmp_path.iterdir()] == [other.name]


def test_arrays_of_a_text_that_was_renamed_are_kept(file: Path, tmp_path: Path, capsys: Capsys) -> None:
    file.rename(tmp_path / "b.usda")
    before = (tmp_path / "a_arrays.usdc").read_bytes()
    said = failed(capsys, "sample", file, "--textures", "0", folder=tmp_path)
    assert "a_arrays.usdc: exists, expected a new file (or --force)" in said
    assert (tmp_path / "a_arrays.usdc").read_bytes() == before
    assert facepipe.open(tmp_path / "b.usda").meshes


def test_results_over_a_head_of_two_files_are_small(file: Path) -> None:
    facepipe.sliders(file, out=file.with_name("over.usda"), values={"smile": 1.0})
    assert file.with_name("over.usda").stat().st_size < 10_000
    assert not file.with_name("over_arrays.usdc").exists()
    assert not file_recipe(file.with_name("over.usda")).standalone


def test_arrays_are_part_of_what_a_source_is(head: FaceParts, file: Path) -> None:
    before = source_digest(file)
    layer = Sdf.Layer.FindOrOpen(str(file.parent / "a_arrays.usdc"))
    text = Sdf.Layer.CreateAnonymous(".usdc")
    text.TransferContent(layer)
    points = text.GetAttributeAtPath(f"/{head.name}/{head.meshes[0].name}.points")
    points.default = Vt.Vec3fArray.FromNumpy(np.asarray(points.default) + np.float32(0.1))
    save_layer(text, file.parent / "a_arrays.usdc")
    assert source_digest(file) != before
    assert file_recipe(file).standalone


def test_a_packed_or_moved_face_has_its_arrays(file: Path, tmp_path: Path) -> None:
    moved = tmp_path / "moved"
    moved.mkdir()
    for name in ("a.usda", "a_arrays.usdc"):
        shutil.move(tmp_path / name, moved / name)
    face = facepipe.open(moved / "a.usda")
    facepipe.sliders(moved / "a.usda", out=tmp_path / "packed.usdz", values={"smile": 0.0})
    assert [len(mesh.points) for mesh in facepipe.open(tmp_path / "packed.usdz").meshes] == [
        len(mesh.points) for mesh in face.meshes
    ]
    assert open_stage(tmp_path / "packed.usdz").GetUsedLayers()
