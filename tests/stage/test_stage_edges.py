"""Stages at the edges of the convention: odd names, numbers that are none, faces wound the other way round."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from faces import grid_mesh, spoiled, tiny_face, with_head
from full_faces import full_face
from parts_differences import assert_same
from pxr import Sdf, Usd, UsdGeom, UsdShade

import facepipe
from facepipe import parts as p
from facepipe.core.errors import InputError, SchemaError
from facepipe.core.names import unique_identifiers
from facepipe.geometry.polygons import point_normals, point_triangles
from facepipe.stage import save_parts
from facepipe.stage.controls_over_time import read_point_cache


def test_inbetweens_whose_names_are_no_identifiers_all_stay(tmp_path: Path) -> None:
    parts = tiny_face()
    shape = parts.meshes[0].blendshapes[1]
    names = ("25", "35", "7.5", "7 5")
    inbetweens = tuple(
        p.Inbetween(name=name, weight=weight, offsets=shape.offsets * weight)
        for name, weight in zip(names, (0.25, 0.35, 0.5, 0.75), strict=True)
    )
    save_parts(with_head(parts, blendshapes=(replace(shape, inbetweens=inbetweens),)), tmp_path / "face.usda")
    read = facepipe.open(tmp_path / "face.usda").meshes[0].blendshapes[0].inbetweens
    assert tuple(one.name for one in read) == unique_identifiers(names)
    assert [one.weight for one in read] == pytest.approx([0.25, 0.35, 0.5, 0.75])
    for own, other in zip(inbetweens, read, strict=True):
        np.testing.assert_allclose(other.offsets, own.offsets, atol=1e-6)


def _first(parts: p.FaceParts, what: str) -> p.FaceParts:
    """The face with a NaN or infinity in one field of its first mesh, animation or elsewhere."""
    head, clip = parts.meshes[0], parts.animations[0]
    assert head.skin is not None
    shape = head.blendshapes[0]
    inbetween = shape.inbetweens[0]
    if what.startswith("clip."):
        field = what.removeprefix("clip.")
        return replace(parts, animations=(replace(clip, **{field: spoiled(getattr(clip, field))}),))
    shapes = {
        "shape.offsets": {"offsets": spoiled(shape.offsets)},
        "shape.normal_offsets": {"normal_offsets": spoiled(shape.normal_offsets, np.inf)},
        "inbetween.offsets": {"inbetweens": (replace(inbetween, offsets=spoiled(inbetween.offsets)),)},
        "inbetween.weight": {"inbetweens": (replace(inbetween, weight=np.nan),)},
    }
    if what in shapes:
        return with_head(parts, blendshapes=(replace(shape, **shapes[what]), *head.blendshapes[1:]))
    if what == "skin":
        return with_head(parts, skin=replace(head.skin, joint_weights=spoiled(head.skin.joint_weights)))
    if what == "region":
        return with_head(parts, regions={"mouth": spoiled(head.regions["mouth"])})
    if what == "uv":
        return with_head(parts, uv_sets=(replace(head.uv_sets[0], values=spoiled(head.uv_sets[0].values)),))
    if what in ("normals", "colors", "transform", "points"):
        return with_head(parts, **{what: spoiled(getattr(head, what))})
    if what == "limits":
        assert parts.bone_limits is not None
        return replace(parts, bone_limits=replace(parts.bone_limits, upper=spoiled(parts.bone_limits.upper, np.inf)))
    if what == "slider":
        return replace(parts, sliders=(replace(parts.sliders[0], channels=(("root/jaw", "rx", np.nan),)),))
    if what == "material":
        return replace(parts, materials=(*parts.materials[:1], replace(parts.materials[1], ior=np.inf)))
    assert what == "unit"
    return replace(parts, meters_per_unit=np.nan)


PLACES = {
    "points": "Head -> points",
    "normals": "Head -> normals",
    "colors": "Head -> colors",
    "transform": "Head -> transform",
    "uv": "Head -> st -> values",
    "region": "Head -> regions -> mouth",
    "skin": "Head -> skin -> joint_weights",
    "shape.offsets": "Head -> jawOpen -> offsets",
    "shape.normal_offsets": "Head -> jawOpen -> normal_offsets",
    "inbetween.offsets": "Head -> jawOpen -> half -> offsets",
    "inbetween.weight": "Head -> jawOpen -> half -> weight",
    "clip.times": "clip -> times",
    "clip.translations": "clip -> translations",
    "clip.coefficients": "clip -> coefficients",
    "clip.shape_weights": "clip -> shape_weights",
    "limits": "bone_limits -> upper",
    "slider": "open -> channels",
    "material": "Lips -> ior",
    "unit": "meters_per_unit",
}


@pytest.mark.parametrize("what", PLACES)
def test_no_number_that_is_none_is_written(tmp_path: Path, what: str) -> None:
    with pytest.raises(InputError) as caught:
        save_parts(_first(full_face(), what), tmp_path / "face.usda")
    assert str(caught.value) == f"Tiny -> {PLACES[what]}: NaN or infinity, expected finite numbers"
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("path", "evaluates"),
    [
        ("/Tiny/Head.primvars:skel:jointWeights", False),
        ("/Tiny/Head.primvars:facepipe:region:mouth", False),
        ("/Tiny/Head.primvars:displayColor", False),
        ("/Tiny/Head.primvars:st", False),
        ("/Tiny/Skeleton.facepipe:boneLimits:upper", True),
        ("/Tiny.facepipe:slider:open:channelGains", True),
    ],
)
def test_no_number_that_is_none_is_read(tmp_path: Path, path: str, evaluates: bool) -> None:
    file = tmp_path / "face.usda"
    save_parts(full_face(), file)
    stage = Usd.Stage.Open(str(file))
    attribute = stage.GetAttributeAtPath(path)
    attribute.Set(type(attribute.Get()).FromNumpy(spoiled(attribute.Get())))
    stage.Save()
    with pytest.raises(SchemaError, match=r"^face\.usda -> .*: NaN or infinity, expected finite numbers$"):
        facepipe.open(file).parts()
    if evaluates:
        facepipe.open(file).evaluate()
    else:
        with pytest.raises(SchemaError, match="NaN or infinity"):
            facepipe.open(file).evaluate()


def test_prims_of_one_name_get_names_of_their_own(tmp_path: Path) -> None:
    file = tmp_path / "face.usda"
    save_parts(replace(tiny_face(), meshes=(grid_mesh("A_Head", 2),)), file)
    stage = Usd.Stage.Open(str(file))
    for folder, size in (("A", 3.0), ("B", 5.0)):
        mesh = UsdGeom.Mesh.Define(stage, f"/Tiny/{folder}/Head")
        mesh.CreatePointsAttr([(0, 0, 0), (size, 0, 0), (0, size, 0)])
        mesh.CreateFaceVertexCountsAttr([3])
        mesh.CreateFaceVertexIndicesAttr([0, 1, 2])
        UsdShade.Material.Define(stage, f"/Tiny/{folder}/Skin")
    UsdShade.Material.Define(stage, "/Tiny/_Tiny_A_Skin")
    stage.Save()
    face = facepipe.open(file)
    assert [mesh.name for mesh in face.meshes] == ["A_Head", "A_Head_2", "B_Head"]
    for mesh in face.meshes:
        points = UsdGeom.Mesh(face.mesh_prim(mesh.name)).GetPointsAttr().Get()
        assert np.array_equal(np.array(points), mesh.points)
    assert list(face.material_names.values()) == ["_Tiny_A_Skin_2", "_Tiny_B_Skin", "_Tiny_A_Skin"]


def test_left_handed_meshes_read_as_their_right_handed_twins(tmp_path: Path) -> None:
    file, parts = tmp_path / "face.usda", full_face()
    head = parts.meshes[0]
    normals = np.random.default_rng(4).normal(size=(len(head.face_vertex_indices), 3)).astype(np.float32)
    parts = with_head(parts, normals=normals)
    save_parts(parts, file)
    twin = facepipe.open(file).parts()
    stage = Usd.Stage.Open(str(file))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/Tiny/Head"))
    st = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").GetIndicesAttr()
    for attribute in (mesh.GetFaceVertexIndicesAttr(), mesh.GetNormalsAttr(), st):
        values = np.array(attribute.Get())
        back = values.reshape(-1, 4, *values.shape[1:])[:, ::-1].reshape(values.shape)
        attribute.Set(type(attribute.Get()).FromNumpy(np.ascontiguousarray(back)))
    mesh.CreateOrientationAttr(UsdGeom.Tokens.leftHanded)
    stage.Save()
    read = facepipe.open(file).parts()
    assert_same(twin, read)
    one = read.meshes[0]
    assert (
        point_normals(one.points, point_triangles(one.face_vertex_counts, one.face_vertex_indices))[:, 2] > 0.99
    ).all()


@pytest.mark.parametrize(
    ("what", "name"),
    [
        ("slider", "value"),  # a property of sliders' API schema
        *product(("slider", "region", "UV set", "landmark scheme"), ("my slider", "2x", "", "a.b", "x:indices")),
    ],
)
def test_names_that_usd_cannot_hold_are_named(tmp_path: Path, what: str, name: str) -> None:
    parts = tiny_face()
    head = parts.meshes[0]
    bad = {
        "slider": lambda: replace(parts, sliders=(p.Slider(name=name),)),
        "region": lambda: with_head(parts, regions={name: head.regions["mouth"]}),
        "UV set": lambda: with_head(parts, uv_sets=(replace(head.uv_sets[0], name=name),)),
        "landmark scheme": lambda: with_head(parts, landmarks={name: head.landmarks["corners"]}),
    }[what]()
    with pytest.raises(InputError, match=f"^/Tiny.*: {what} '{name}'.*expected"):
        save_parts(bad, tmp_path / "face.usda")
    assert not list(tmp_path.iterdir())


def test_time_range_of_clips_is_on_the_stage(tmp_path: Path) -> None:
    parts = full_face()
    clip, pose = parts.animations
    assert clip.times is not None
    later = replace(clip, name="later", times=clip.times + 0.5)
    save_parts(replace(parts, animations=(later, pose, clip)), tmp_path / "clips.usda")
    save_parts(replace(parts, animations=(pose,)), tmp_path / "poses.usda")
    stage = Usd.Stage.Open(str(tmp_path / "clips.usda"))
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0.0, 1.5 * stage.GetTimeCodesPerSecond())
    assert not Sdf.Layer.FindOrOpen(str(tmp_path / "poses.usda")).HasStartTimeCode()


def test_a_clip_with_nan_is_refused_when_it_is_sampled(tmp_path: Path) -> None:
    clip = p.Animation(name="clip", shapes=("jawOpen",), shape_weights=np.float32([[0.625]]))
    file = tmp_path / "face.usda"
    save_parts(replace(tiny_face(), animations=(clip,)), file)
    file.write_text(file.read_text().replace("[0.625]", "[nan]"))
    with pytest.raises(SchemaError, match="clip -> shape_weights: NaN"):
        facepipe.open(file).sample("clip")


@pytest.mark.parametrize("rate", [0.0, -24.0, np.nan, np.inf])
@pytest.mark.parametrize("above", [True, False])
def test_clocks_that_stand_still_are_refused_between_layers(tmp_path: Path, rate: float, *, above: bool) -> None:
    """USD (seen in 26.11) looks for time samples without end below a layer of 0 time codes per second."""
    save_parts(full_face(), tmp_path / "face.usda")
    top = Sdf.Layer.CreateNew(str(tmp_path / "top.usda"))
    top.subLayerPaths = ["./face.usda"]
    below = Sdf.Layer.FindOrOpen(str(tmp_path / "face.usda"))
    (top if above else below).timeCodesPerSecond = rate
    top.defaultPrim = below.defaultPrim
    assert top.Save()
    assert below.Save()
    with pytest.raises(InputError, match=r"top.usda.*timeCodesPerSecond is .*, expected a finite number above 0"):
        facepipe.open(tmp_path / "top.usda")


def test_a_point_cache_with_a_name_twice_is_refused_and_names_it(tmp_path: Path) -> None:
    stage = Usd.Stage.CreateNew(str(tmp_path / "cache.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    for path in ("/Eye", "/Left/Lash", "/Right/Lash"):
        UsdGeom.Mesh.Define(stage, path)
    stage.Save()
    with pytest.raises(InputError, match="-> Lash: is the name of more than one mesh, expected different names"):
        read_point_cache(tmp_path / "cache.usda")
