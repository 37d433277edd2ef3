"""Materials, textures, seams and tangents in glTF files."""

from __future__ import annotations

import struct
import zlib
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from faces import grid_mesh, replace_mesh, tiny_face
from gltf_export import Writing, writing, written
from gltf_reader import Gltf
from PIL import Image
from textures import COLORS, RNG, picture, textured

from facepipe.parts import FaceParts, Material, MaterialFaces, Mesh, Texture, UvSet

__all__ = ["writing", "written"]

MASK = RNG.integers(0, 256, (8, 8), np.uint8)
PACKED = RNG.integers(0, 256, (8, 8, 3), np.uint8)


def face(material: Material, **changes: Any) -> FaceParts:
    """A grid with one UV per point and this material."""
    mesh = replace_mesh(grid_mesh(size=8), material=material.name, **changes)
    return FaceParts(name="Face", meshes=(mesh,), materials=(material,))


def pbr(file: Gltf) -> dict[str, Any]:
    result: dict[str, Any] = file.list("materials")[0]["pbrMetallicRoughness"]
    return result


@pytest.mark.parametrize("name", ["face.glb", "face.gltf"])
@pytest.mark.parametrize("kind", ["PNG", "JPEG"])
def test_pictures_keep_their_bytes(name: str, kind: str, writing: Writing) -> None:
    texture = picture(f"skin colour é #1.{kind.lower()}", COLORS, kind)
    source = textured(texture, scale=(0.5, 1.0, 0.25, 1.0), wrap_s="mirror", wrap_t="clamp")
    file, report = writing(face(Material(name="skin", diffuse_color=source)), name)
    assert file.image(0) == texture.data
    assert pbr(file)["baseColorFactor"] == [0.5, 1.0, 0.25, 1.0]
    assert file.list("samplers") == [{"wrapS": 33648, "wrapT": 33071}]
    assert len(report.files) == (1 if name.endswith("glb") else 3)
    assert all(str(path.name).isascii() for path in report.files)


def test_other_kinds_become_png_with_the_same_pixels(writing: Writing) -> None:
    file, _ = writing(face(Material(name="skin", diffuse_color=textured(picture("skin.bmp", COLORS, "BMP")))))
    assert file.image(0).startswith(b"\x89PNG")
    assert (file.pixels(pbr(file)["baseColorTexture"])[..., :3] == COLORS).all()


def test_colour_profiles_go_and_pixels_stay(writing: Writing) -> None:
    """glTF ignores profiles, and its validator warns of them."""
    data = picture("skin.png", COLORS).data
    profile = b"iCCP" + b"x\0\0" + zlib.compress(b"profile")
    chunk = struct.pack(">I", len(profile) - 4) + profile + struct.pack(">I", zlib.crc32(profile))
    texture = Texture(name="skin.png", data=data[:33] + chunk + data[33:])
    file, _ = writing(face(Material(name="skin", diffuse_color=textured(texture))))
    assert file.image(0) == data


def test_an_unreadable_picture_is_left_out_and_said(writing: Writing) -> None:
    broken = Texture(name="skin.exr", data=b"\x76\x2f\x31\x01 not a picture")
    file, report = writing(face(Material(name="skin", diffuse_color=textured(broken), metallic=textured(broken, "b"))))
    assert not file.list("images")
    assert pbr(file)["metallicFactor"] == 0.0
    assert any("skin.exr" in line for line in report.warnings)


@pytest.mark.parametrize(("threshold", "mode"), [(0.0, "BLEND"), (0.4, "MASK")])
def test_opacity_of_another_picture_becomes_alpha(threshold: float, mode: str, writing: Writing) -> None:
    material = Material(
        name="lashes",
        diffuse_color=textured(picture("skin.png", COLORS)),
        opacity=textured(picture("mask.png", MASK), "r"),
        opacity_threshold=threshold,
    )
    file, _ = writing(face(material, double_sided=True))
    pixels = file.pixels(pbr(file)["baseColorTexture"])
    assert (pixels == np.dstack([COLORS, MASK])).all()
    entry = file.list("materials")[0]
    assert entry["alphaMode"] == mode
    assert entry.get("alphaCutoff") == (threshold or None)
    assert entry["doubleSided"]


def test_opacity_with_a_plain_colour(writing: Writing) -> None:
    material = Material(name="glass", diffuse_color=(0.2, 0.4, 0.6), opacity=textured(picture("m.png", MASK), "g"))
    file, _ = writing(face(material))
    assert (file.pixels(pbr(file)["baseColorTexture"]) == np.dstack([np.full((8, 8, 3), 255, np.uint8), MASK])).all()
    assert pbr(file)["baseColorFactor"] == [0.2, 0.4, 0.6, 1.0]


def test_packed_occlusion_roughness_metallic_is_used_as_it_is(writing: Writing) -> None:
    texture = picture("orm.png", PACKED)
    material = Material(
        name="skin", metallic=textured(texture, "b"), roughness=textured(texture, "g"), occlusion=textured(texture, "r")
    )
    file, _ = writing(face(material))
    assert [file.image(i) for i in range(len(file.list("images")))] == [texture.data]
    assert pbr(file)["metallicRoughnessTexture"] == file.list("materials")[0]["occlusionTexture"] == {"index": 0}
    assert (pbr(file)["metallicFactor"], pbr(file)["roughnessFactor"]) == (1.0, 1.0)


@pytest.mark.parametrize(
    ("scale", "bias", "strength"), [(1.0, 0.0, None), (0.25, 0.75, 0.25), (0.25, 0.0, None), (1.5, -0.5, None)]
)
def test_occlusion_has_the_strength_that_scale_and_bias_stand_for(
    scale: float, bias: float, strength: float | None, writing: Writing
) -> None:
    """glTF reads ``1 + strength * (value - 1)``, strengths 0 to 1; others are left out with a warning."""
    occlusion = textured(picture("o.png", MASK), "r", scale=(scale, 1, 1, 1), bias=(bias, 0, 0, 0))
    file, report = writing(face(Material(name="skin", occlusion=occlusion)))
    assert file.list("materials")[0]["occlusionTexture"].get("strength") == strength
    left_out = any("scale and bias of the occlusion texture left out" in line for line in report.warnings)
    assert left_out == (strength is None and scale != 1.0)


def test_separate_metallic_and_roughness_are_packed(writing: Writing) -> None:
    small = MASK[::2, ::4]
    material = Material(
        name="skin",
        metallic=textured(picture("m.png", small), "r"),
        roughness=textured(picture("r.png", MASK), "r", scale=(0.7, 1, 1, 1)),
    )
    file, _ = writing(face(material))
    pixels = file.pixels(pbr(file)["metallicRoughnessTexture"])
    assert pbr(file)["roughnessFactor"] == 0.7
    resized = np.asarray(Image.fromarray(small).resize((8, 8), Image.Resampling.BILINEAR))
    assert (pixels[..., 1] == MASK).all()
    assert (pixels[..., 2] == resized).all()


def test_roughness_alone_in_another_channel(writing: Writing) -> None:
    file, _ = writing(face(Material(name="skin", metallic=0.5, roughness=textured(picture("r.png", MASK), "r"))))
    pixels = file.pixels(pbr(file)["metallicRoughnessTexture"])
    assert (pixels[..., 1] == MASK).all()
    assert (pixels[..., 2] == 255).all()
    assert pbr(file)["metallicFactor"] == 0.5


def test_a_clear_coat(writing: Writing) -> None:
    rough = textured(picture("r.png", MASK), "b")
    file, _ = writing(face(Material(name="lips", clearcoat=0.4, clearcoat_roughness=rough)))
    coat = file.list("materials")[0]["extensions"]["KHR_materials_clearcoat"]
    assert (coat["clearcoatFactor"], coat["clearcoatRoughnessFactor"]) == (0.4, 1.0)
    assert (file.pixels(coat["clearcoatRoughnessTexture"])[..., 1] == MASK).all()
    assert "clearcoatTexture" not in coat


def test_emission_beyond_one_and_index_of_refraction(writing: Writing) -> None:
    file, _ = writing(face(Material(name="eye", emissive_color=(4.0, 2.0, 0.0), ior=1.376)))
    entry = file.list("materials")[0]
    assert entry["emissiveFactor"] == [1.0, 0.5, 0.0]
    assert entry["extensions"]["KHR_materials_emissive_strength"] == {"emissiveStrength": 4.0}
    assert entry["extensions"]["KHR_materials_ior"] == {"ior": 1.376}
    assert file.json["extensionsUsed"] == ["KHR_materials_emissive_strength", "KHR_materials_ior"]


def test_a_bias_of_the_emission_is_left_out_and_named(writing: Writing) -> None:
    glow = textured(picture("glow.png", COLORS), scale=(0.5, 0.25, 1.0, 1.0), bias=(0.0, 0.1, 0.0, 0.0))
    file, report = writing(face(Material(name="eye", emissive_color=glow)))
    assert report.warnings == ("eye: bias of the emissiveColor texture left out",)
    assert file.list("materials")[0]["emissiveFactor"] == [0.5, 0.25, 1.0]


def tangent_frames(file: Gltf) -> tuple[np.ndarray, ...]:
    attributes = file.list("meshes")[0]["primitives"][0]["attributes"]
    return tuple(file.decoded(attributes[name]) for name in ("POSITION", "NORMAL", "TANGENT"))


@pytest.mark.parametrize("quantize", [False, True])
def test_tangents_run_along_u_and_their_bitangents_along_v(quantize: bool, writing: Writing) -> None:
    """On a flat grid the frame is known: u along x, v along y."""
    normal = textured(picture("n.png", PACKED), scale=(2, 2, 2, 2), bias=(-1, -1, -1, -1))
    file, _ = writing(face(Material(name="skin", normal=normal)), quantize=quantize)
    _, normals, tangents = tangent_frames(file)
    assert np.allclose(tangents[:, :3], (1, 0, 0), atol=1e-6)
    assert np.allclose(np.cross(normals, tangents[:, :3]) * tangents[:, 3:], (0, 1, 0), atol=1e-6)
    assert file.list("materials")[0]["normalTexture"] == {"index": 0}


def test_mirrored_uvs_split_and_flip_the_frame(writing: Writing) -> None:
    """A grid whose right half mirrors the UVs of its left half, sharing the middle."""
    mesh = grid_mesh(size=7)
    uv = np.array(mesh.uv_sets[0].values)
    uv[:, 0] = np.minimum(uv[:, 0], 1 - uv[:, 0])
    material = Material(name="skin", normal=textured(picture("n.png", PACKED), scale=(2, 2, 2, 2)))
    parts = FaceParts(meshes=(replace_mesh(mesh, uv_sets=(UvSet(values=uv),), material="skin"),), materials=(material,))
    file, report = writing(parts)
    positions, normals, tangents = tangent_frames(file)
    assert report.counts["vertices"] == 49 + 7
    right = tangents[:, 3] < 0
    assert (positions[right, 0] >= 0).all()
    assert np.allclose(tangents[:, :3], np.where(right[:, None], (-1.0, 0, 0), (1.0, 0, 0)), atol=1e-6)
    assert np.allclose(np.cross(normals, tangents[:, :3]) * tangents[:, 3:], (0, 1, 0), atol=1e-6)


def test_a_normal_map_with_green_down_is_turned(writing: Writing) -> None:
    normal = textured(picture("n.png", PACKED), scale=(2, -2, 2, 2), bias=(-1, 1, -1, -1))
    file, _ = writing(face(Material(name="skin", normal=normal)))
    pixels = file.pixels(file.list("materials")[0]["normalTexture"])
    expected = PACKED.copy()
    expected[..., 1] = 255 - expected[..., 1]
    assert (pixels == expected).all()


@pytest.mark.parametrize(
    ("scale", "strength"), [((1, 1, 1, 1), {}), ((2, 2, 2, 2), {}), ((3, 3, 2, 2), {"scale": 1.5})]
)
def test_normal_maps_are_as_strong_as_their_scale(
    scale: tuple[float, ...], strength: dict[str, float], writing: Writing
) -> None:
    """A texture without scale and bias is read as glTF reads it."""
    file, _ = writing(face(Material(name="skin", normal=textured(picture("n.png", PACKED), scale=scale))))
    entry = file.list("materials")[0]["normalTexture"]
    assert {key: value for key, value in entry.items() if key == "scale"} == strength


def cube() -> Mesh:
    """A cube with a UV square and a flat normal on every side: each corner point has three vertices."""
    points = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    normals = np.repeat([(-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, -1), (0, 0, 1)], 4, axis=0)
    square = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], float)
    return Mesh(
        name="Cube",
        points=points,
        face_vertex_counts=np.full(6, 4),
        face_vertex_indices=np.array(sides).ravel(),
        normals=normals.astype(float),
        uv_sets=(UvSet(values=square, indices=np.tile(np.arange(4), 6)), UvSet(name="st1", values=points[:, :2])),
    )


def test_points_split_at_seams_and_nowhere_else(writing: Writing) -> None:
    mesh = cube()
    file, report = writing(FaceParts(meshes=(mesh,)))
    assert report.counts["vertices"] == 24
    assert report.counts["triangles"] == 12
    attributes = file.list("meshes")[0]["primitives"][0]["attributes"]
    numbers = file.decoded(attributes["_FACEPIPE_POINT"]).astype(int)
    assert np.bincount(numbers).tolist() == [3] * 8
    assert np.allclose(file.decoded(attributes["POSITION"]), mesh.points[numbers] * 0.01)
    assert np.allclose(file.decoded(attributes["TEXCOORD_1"]), mesh.points[numbers, :2] * (1, -1) + (0, 1))
    smooth, smooth_report = writing(FaceParts(meshes=(replace(mesh, normals=None, uv_sets=()),)), "smooth.glb")
    assert smooth_report.counts["vertices"] == 8
    assert "TEXCOORD_0" not in smooth.list("meshes")[0]["primitives"][0]["attributes"]


def test_corners_keep_their_own_uv_and_normal(writing: Writing) -> None:
    """Every triangle of the file has the UVs and normal that its side has in the mesh."""
    mesh = cube()
    file, _ = writing(FaceParts(meshes=(mesh,)))
    primitive = file.list("meshes")[0]["primitives"][0]
    triangles = file.stored(primitive["indices"]).reshape(-1, 3)
    arrays = {name: file.decoded(index) for name, index in primitive["attributes"].items()}
    assert mesh.normals is not None
    indices = mesh.uv_sets[0].indices
    assert indices is not None
    for number, triangle in enumerate(triangles):
        corners = 4 * (number // 2) + np.array([(0, 1, 2), (0, 2, 3)][number % 2])
        uv = mesh.uv_sets[0].values[indices[corners]]
        assert np.allclose(arrays["TEXCOORD_0"][triangle], np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1))
        assert np.allclose(arrays["NORMAL"][triangle], mesh.normals[corners])


@pytest.mark.parametrize("quantize", [False, True])
def test_one_primitive_a_material_all_with_the_same_targets(quantize: bool, writing: Writing) -> None:
    parts = tiny_face()
    head = replace_mesh(
        parts.meshes[0],
        material="skin",
        material_faces=(
            MaterialFaces(material="lips", faces=np.array([0, 1, 7])),
            MaterialFaces(material="brow", faces=np.array([24])),
        ),
    )
    materials = tuple(Material(name=name) for name in ("lips", "skin", "brow", "unused"))
    parts = replace(parts, meshes=(head, parts.meshes[1]), materials=materials)
    file, report = writing(parts, quantize=quantize)
    primitives = file.mesh("Head")["primitives"]
    names = [file.list("materials")[primitive["material"]]["name"] for primitive in primitives]
    assert names == ["skin", "lips", "brow"]
    assert [len(file.stored(primitive["indices"])) // 3 for primitive in primitives] == [2 * 21, 2 * 3, 2]
    assert {len(primitive["targets"]) for primitive in primitives} == {3}
    assert len(file.mesh("Head")["weights"]) == len(file.targets("Head")) == 3
    assert report.counts["primitives"] == 4


def test_colours_are_kept_where_no_material_decides(writing: Writing) -> None:
    colors = np.random.default_rng(0).random((64, 3))
    mesh = replace_mesh(grid_mesh(size=8), colors=colors)
    for quantize in (False, True):
        file, _ = writing(FaceParts(meshes=(mesh,)), f"{quantize}.glb", quantize=quantize)
        attributes = file.list("meshes")[0]["primitives"][0]["attributes"]
        numbers = file.decoded(attributes["_FACEPIPE_POINT"]).astype(int)
        assert np.allclose(file.decoded(attributes["COLOR_0"]), colors[numbers], atol=1e-5)
    file, report = writing(face(Material(name="skin", diffuse_color=(0.5, 0.4, 0.3)), colors=colors), "material.glb")
    assert "COLOR_0" not in file.list("meshes")[0]["primitives"][0]["attributes"]
    assert any("display colours" in line for line in report.dropped)


def test_textures_without_uvs_are_left_out_and_said(writing: Writing) -> None:
    material = Material(name="skin", diffuse_color=textured(picture("skin.png", COLORS)), roughness=0.3)
    file, report = writing(face(material, uv_sets=()))
    assert not file.list("images")
    assert pbr(file)["roughnessFactor"] == 0.3
    assert any("without UVs" in line for line in report.warnings)


def test_a_second_uv_set_is_read_by_its_number(writing: Writing) -> None:
    mesh = grid_mesh(size=8)
    uv = mesh.uv_sets[0].values
    sets = (UvSet(values=uv), UvSet(name="detail", values=np.asarray(uv) * 3))
    material = Material(name="skin", diffuse_color=textured(picture("skin.png", COLORS), uv_set="detail"))
    file, _ = writing(face(material, uv_sets=sets))
    assert pbr(file)["baseColorTexture"]["texCoord"] == 1
