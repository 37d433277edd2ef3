"""What UsdSkel files hold beside the plain case: chosen, kept or named, with UsdSkel itself as judge."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from faces import tiny_face
from foreign_stages import HEAD, TEETH, foreign_stage, read, rich_face, warned, written
from oracle import bake, difference, played
from pxr import Sdf, Usd, UsdGeom, UsdLux, UsdSkel

from facepipe.core.errors import InputError
from facepipe.importers import load
from facepipe.importers.options import parse_variants
from facepipe.importers.usd import Options
from facepipe.stage import Face
from facepipe.stage.values import to_vec3f


def with_variants() -> Usd.Stage:
    """A face that is wider in the variant `wide` of the set `build`, and has teeth by a set within."""
    stage = foreign_stage(tiny_face(3))
    head, teeth = stage.GetPrimAtPath("/Tiny/Head"), stage.GetPrimAtPath("/Tiny/Teeth")
    points = UsdGeom.Mesh(head).GetPointsAttr()
    narrow = np.array(points.Get())
    teeth.SetActive(False)
    root = stage.GetDefaultPrim()
    builds = root.GetVariantSets().AddVariantSet("build")
    points.Clear()
    for name, factor in (("narrow", 1.0), ("wide", 2.0)):
        builds.AddVariant(name)
        builds.SetVariantSelection(name)
        with builds.GetVariantEditContext():
            points.Set(to_vec3f(narrow * [factor, 1, 1]))
            if name == "wide":
                inner = root.GetVariantSets().AddVariantSet("tint")
                for tint in ("red", "blue"):
                    inner.AddVariant(tint)
                inner.SetVariantSelection("red")
    builds.SetVariantSelection("narrow")
    return stage


def width(path: Path, **options: str) -> tuple[float, tuple[str, ...]]:
    imported = load("usd", path, Options(variant=options))
    return float(np.ptp(imported.parts.meshes[0].points[:, 0])), imported.warnings


def test_variants_are_chosen_or_named(tmp_path: Path) -> None:
    path = written(with_variants(), tmp_path / "face.usda")
    narrow, said = width(path)
    assert said == ("</Tiny>: variant narrow of the set build is read, of narrow, wide (--variant build=NAME chooses)",)
    wide, said = width(path, build="wide")
    assert wide == 2 * narrow
    (line,) = said
    assert "variant red of the set tint is read, of blue, red" in line  # which only `wide` brings
    assert width(path, build="wide", tint="blue")[1] == ()
    assert path.read_text() == written(with_variants(), tmp_path / "again.usda").read_text()  # the file itself stays


@pytest.mark.parametrize(
    ("chosen", "message"),
    [
        ("biuld=wide", "no variant set 'biuld', did you mean 'build'?"),
        ("build=widde", "variant set build: no variant 'widde', did you mean 'wide'?"),
        ("tint=blue", "no variant set 'tint', expected one of build"),
    ],
)
def test_variants_that_are_not_there(chosen: str, message: str, tmp_path: Path) -> None:
    path = written(with_variants(), tmp_path / "face.usda")
    with pytest.raises(InputError) as caught:
        load("usd", path, Options(variant=parse_variants(chosen)))
    assert message in str(caught.value)


@pytest.mark.parametrize("text", ["build", "=wide", "build=", "a=b,a=c"])
def test_variants_are_pairs(text: str) -> None:
    with pytest.raises(InputError, match="option variant"):
        parse_variants(text)


def shape(stage: Usd.Stage) -> UsdSkel.BlendShape:
    return UsdSkel.BlendShape(stage.GetPrimAtPath(f"{HEAD}/jawOpen"))


@pytest.mark.parametrize("dense", [False, True])
def test_a_shape_of_an_inbetween_alone_moves_as_usdskel_says(dense: bool, tmp_path: Path) -> None:
    stage = foreign_stage(rich_face())
    own = shape(stage)
    if dense:
        moved = np.zeros((36, 3), np.float32)
        moved[np.array(own.GetPointIndicesAttr().Get())] = np.array(own.GetInbetweens()[0].GetOffsets())
        own.GetInbetweens()[0].SetOffsets(to_vec3f(moved))
        own.GetPrim().RemoveProperty("pointIndices")
    for name in ("offsets", "normalOffsets"):
        own.GetPrim().RemoveProperty(name)
    stage.GetPrimAtPath(TEETH).SetActive(False)
    for weight in (0.2, 0.5, 0.9):
        pose = UsdSkel.Animation.Define(stage, f"/Rich/Animations/at{10 * weight:.0f}")
        pose.CreateBlendShapesAttr(["jawOpen"])
        pose.CreateBlendShapeWeightsAttr([weight])
    path = written(stage, tmp_path / "face.usda")
    face = Face.from_parts(read(path).parts)
    for weight in (0.2, 0.5, 0.9):
        (expected,) = played(path, animation=f"at{10 * weight:.0f}")
        assert difference(face, face.evaluate({"jawOpen": weight}), expected) < 1e-5
        assert difference(face, face.evaluate({}), expected) > 1e-3


def test_a_shape_of_normal_offsets_alone_is_kept(tmp_path: Path) -> None:
    stage = foreign_stage(rich_face())
    turned = np.array(shape(stage).GetNormalOffsetsAttr().Get())
    for name in ("offsets", "inbetweens:half"):
        shape(stage).GetPrim().RemoveProperty(name)
    imported = read(written(stage, tmp_path / "face.usda"))
    own = imported.parts.meshes[0].blendshapes[0]
    assert own.name == "jawOpen"
    assert own.normal_offsets is not None
    assert np.array_equal(own.normal_offsets, turned)
    assert not own.offsets.any()
    assert own.inbetweens == ()


def blender_names(stage: Usd.Stage) -> None:
    """The second mesh's jawOpen as Blender 5 writes it: its name numbered, its prim's not."""
    stage.GetPrimAtPath(TEETH).GetAttribute("skel:blendShapes").Set(["jawOpen2"])


def test_shapes_of_several_meshes_that_are_one_are_joined(tmp_path: Path) -> None:
    truth = Face.from_parts(rich_face())
    stage = foreign_stage(rich_face())
    blender_names(stage)
    imported = read(written(stage, tmp_path / "face.usda"))
    warned(imported, "1 shapes joined with those of other meshes, by their prims' names: jawOpen2 is jawOpen")
    face = Face.from_parts(imported.parts)
    assert face.shapes == truth.shapes
    expected = bake(truth, {"jawOpen": 0.7})
    assert difference(truth, face.evaluate({"jawOpen": 0.7}), expected) < 1e-5


def test_shapes_that_an_animation_moves_apart_stay_two(tmp_path: Path) -> None:
    stage = foreign_stage(rich_face())
    blender_names(stage)
    animation = UsdSkel.Animation.Define(stage, "/Rich/Animations/talk")
    animation.CreateBlendShapesAttr(["jawOpen", "jawOpen2"])
    animation.CreateBlendShapeWeightsAttr([0.5, 0.25])
    imported = read(written(stage, tmp_path / "face.usda"))
    assert Face.from_parts(imported.parts).shapes == ("jawOpen", "mouthSmileLeft", "jawOpen2")
    animation.GetBlendShapeWeightsAttr().Set([0.5, 0.5])
    imported = read(written(stage, tmp_path / "alike.usda"))
    (talk,) = imported.parts.animations
    assert (talk.shapes, Face.from_parts(imported.parts).shapes) == (("jawOpen",), ("jawOpen", "mouthSmileLeft"))


def test_properties_and_prims_of_no_face_are_named(tmp_path: Path) -> None:
    stage = foreign_stage(rich_face())
    head = stage.GetPrimAtPath(HEAD)
    head.CreateAttribute("userProperties:rig_version", Sdf.ValueTypeNames.Int).Set(3)
    head.SetCustomDataByKey("artist", "me")
    head.CreateAttribute("userProperties:blender:object_name", Sdf.ValueTypeNames.String).Set("Head")
    UsdGeom.Camera.Define(stage, "/Rich/Camera")
    UsdLux.SphereLight.Define(stage, "/Rich/Lamp")
    assert sorted(read(written(stage, tmp_path / "face.usda")).warnings) == [
        "</Rich/Camera>: 1 of type Camera: left out",
        f"<{HEAD}>: customData artist, which no schema knows: left out",
        f"<{HEAD}>: userProperties:rig_version, which no schema knows: left out",
        "</Rich/Lamp>: 1 of type SphereLight: left out",
    ]
