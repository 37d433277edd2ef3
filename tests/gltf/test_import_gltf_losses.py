"""What a glTF file has that a face can't hold is named, and what seems nothing is kept."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from facepipe_gltf import Options as WriteOptions
from facepipe_gltf import read as gltf
from facepipe_gltf import save, write
from gltf_builder import PNG, Builder, build, make_model
from gltf_reader import read as read_gltf

import facepipe
from facepipe.rig.animation import local_transforms
from facepipe.stage import save_parts
from facepipe.stage.recipes import Imported


def read(folder: Path, builder: Builder) -> Imported:
    (folder / "face.glb").write_bytes(builder.glb())
    return gltf.read(folder / "face.glb", gltf.Options())


def primitive(builder: Builder) -> dict[str, object]:
    found: dict[str, object] = builder.root["meshes"][0]["primitives"][0]
    return found


def with_tangents(builder: Builder) -> None:
    tangents = np.tile([1.0, 0.0, 0.0, 1.0], (54, 1))
    primitive(builder)["attributes"]["TANGENT"] = builder.array(tangents)  # type: ignore[index]
    primitive(builder)["targets"][0]["TANGENT"] = builder.array(tangents[:, :3])  # type: ignore[index]


def with_extras(builder: Builder) -> None:
    builder.root["nodes"][1]["extras"] = {"ragdoll": 1, "mass": 2}
    builder.root["nodes"][2]["extras"] = {"ragdoll": 3}
    builder.root["meshes"][0]["extras"]["author"] = "me"


def with_camera(builder: Builder) -> None:
    builder.add("cameras", {"type": "perspective", "perspective": {"yfov": 1, "znear": 1}})


def with_sharp_texels(builder: Builder) -> None:
    builder.add("samplers", {"magFilter": 9728})


def without_names(builder: Builder) -> None:
    del builder.root["meshes"][0]["extras"]


def with_an_empty_name(builder: Builder) -> None:
    builder.root["meshes"][0]["extras"]["targetNames"][1] = ""


def with_own_attribute(builder: Builder) -> None:
    primitive(builder)["attributes"]["_MASK"] = builder.array(np.zeros(54))  # type: ignore[index]


def with_a_ninth_uv_set(builder: Builder) -> None:
    primitive(builder)["attributes"]["TEXCOORD_8"] = builder.array(np.zeros((54, 2)))  # type: ignore[index]


def with_one_side_of_two(builder: Builder) -> None:
    other = builder.add("materials", {"name": "inside"})
    primitives = builder.root["meshes"][0]["primitives"]
    primitives.append({**primitives[0], "material": other})


def with_tinted_material(builder: Builder) -> None:
    builder.root["materials"][0]["pbrMetallicRoughness"] = {"baseColorFactor": [0.5, 1, 1, 1]}
    primitive(builder)["attributes"]["COLOR_0"] = builder.array(np.full((54, 3), 0.5))  # type: ignore[index]


def with_placed_texture(**place: object) -> Callable[[Builder], None]:
    def edit(builder: Builder) -> None:
        builder.add("images", {"bufferView": builder.view(PNG)})
        texture = builder.add("textures", {"source": 0})
        reference = {"index": texture, "extensions": {"KHR_texture_transform": place}}
        builder.root["materials"][0]["pbrMetallicRoughness"] = {"baseColorTexture": reference}

    return edit


def with_ktx2(builder: Builder) -> None:
    """A base colour in KTX2 alone, and normals with a PNG beside it."""
    ktx2 = builder.add("images", {"bufferView": builder.view(b"\xabKTX 20\xbb\r\n\x1a\n"), "mimeType": "image/ktx2"})
    png = builder.add("images", {"bufferView": builder.view(PNG)})
    extensions = {"KHR_texture_basisu": {"source": ktx2}}
    alone = builder.add("textures", {"extensions": extensions})
    beside = builder.add("textures", {"source": png, "extensions": extensions})
    surface = {"baseColorTexture": {"index": alone}, "metallicRoughnessTexture": {"index": beside}}
    builder.root["materials"][0]["pbrMetallicRoughness"] = surface
    builder.root |= {"extensionsUsed": [*extensions], "extensionsRequired": [*extensions]}


def with_rounded_point_numbers(builder: Builder) -> None:
    primitive(builder)["attributes"]["_FACEPIPE_POINT"] = builder.array(np.arange(54) + 0.01)  # type: ignore[index]


def with_extensions(builder: Builder) -> None:
    builder.root["materials"][0]["extensions"] = {"KHR_materials_ior": {"ior": 1.4}, "KHR_materials_transmission": {}}


def with_mean_normals(builder: Builder) -> None:
    turned = np.zeros((54, 3))
    turned[48] = 0.5  # the twin of a vertex at the seam
    primitive(builder)["targets"][0]["NORMAL"] = builder.array(turned)  # type: ignore[index]


@pytest.mark.parametrize(
    ("edit", "lines"),
    [
        (with_tangents, ["TANGENT of 1 primitive left out", "tangents of 1 morph target left out"]),
        (with_extras, ["extras of 2 nodes ('ragdoll', 'mass') left out", "extras of 1 mesh ('author') left out"]),
        (with_camera, ["1 camera left out"]),
        (with_sharp_texels, ["1 nearest texel filter left out"]),
        (without_names, ["its 3 morph targets have no names"]),
        (with_an_empty_name, ["1 of 3 names are empty"]),
        (with_own_attribute, ["the attribute '_MASK' is left out"]),
        (with_a_ninth_uv_set, ["the attribute 'TEXCOORD_8' is left out"]),
        (with_one_side_of_two, ["only some of its materials are double-sided"]),
        (with_tinted_material, ["vertex colours tint a material"]),
        (with_extensions, ["the extension 'KHR_materials_transmission' is left out"]),
        (with_ktx2, ["textures[0]: its image is KTX2 (KHR_texture_basisu), which is not decoded: left out"]),
        (with_rounded_point_numbers, ["_FACEPIPE_POINT with numbers other than whole ones from 0 to 2^24: left out"]),
        (with_mean_normals, ["normal offsets differ at seams"]),
        (with_placed_texture(offset=[0, 0], scale=[1, 1], rotation=0), []),
        (with_placed_texture(offset=[0.5, 0], rotation=0.1), []),
    ],
)
def test_what_a_face_cannot_hold_is_named(edit: Callable[[Builder], object], lines: list[str], tmp_path: Path) -> None:
    builder = build(make_model())
    assert read(tmp_path, builder).warnings == ()
    edit(builder)
    warnings = read(tmp_path, builder).warnings
    assert len(warnings) == len(lines)
    for warning, line in zip(sorted(warnings), sorted(lines), strict=True):
        assert line in warning


def test_no_material_is_white_and_rough_metal(tmp_path: Path) -> None:
    builder = build(make_model())
    del primitive(builder)["material"]
    parts = read(tmp_path, builder).parts
    (material,) = parts.materials
    assert parts.meshes[0].material == material.name
    assert (material.diffuse_color, material.metallic, material.roughness) == ((1.0, 1.0, 1.0), 1.0, 1.0)
    assert material.occlusion == 1.0
    save(write(replace(parts, meters_per_unit=0.01), WriteOptions()), tmp_path / "again.glb")
    (again,) = read_gltf(tmp_path / "again.glb").json["materials"]
    surface = again["pbrMetallicRoughness"]  # what glTF 2.0 takes where nothing is said
    assert [surface.get(key, 1.0) for key in ("metallicFactor", "roughnessFactor")] == [1.0, 1.0]
    assert surface.get("baseColorFactor", [1.0] * 4) == [1.0] * 4


def test_vertex_colours_without_a_material_stay(tmp_path: Path) -> None:
    builder = build(make_model())
    del primitive(builder)["material"]
    colors = np.linspace(0, 1, 54)[:, None] * [1.0, 0.5, 0.25]
    colors[48:] = colors[[4 + 8 * row for row in range(6)]]
    primitive(builder)["attributes"]["COLOR_0"] = builder.array(colors)  # type: ignore[index]
    imported = read(tmp_path, builder)
    save(write(imported.parts, WriteOptions()), tmp_path / "again.glb")
    file = read_gltf(tmp_path / "again.glb")
    attributes = file.json["meshes"][0]["primitives"][0]["attributes"]
    points = file.decoded(attributes["_FACEPIPE_POINT"]).ravel().astype(int)
    mesh = imported.parts.meshes[0]
    assert mesh.colors is not None
    assert np.allclose(file.decoded(attributes["COLOR_0"]), mesh.colors[points])
    assert np.allclose(np.sort(mesh.colors, axis=0), np.sort(colors[:48], axis=0))
    assert any("without a material" in line for line in imported.warnings)


def test_scales_of_joints_stay_finer_than_usd_keeps_them(tmp_path: Path) -> None:
    model = make_model()
    builder = build(model)
    scales = np.array([[1.0, 1.0, 1.0], [1.0003, 0.9997, 1.00021]])
    samplers = [{"input": builder.array(np.array([0.0, 1.0])), "output": builder.array(scales)}]
    channels = [{"sampler": 0, "target": {"node": 3, "path": "scale"}}]
    builder.add("animations", {"name": "breathe", "channels": channels, "samplers": samplers})
    parts = read(tmp_path, builder).parts
    save_parts(parts, tmp_path / "face.usda")
    again = facepipe.open(tmp_path / "face.usda").parts()
    (animation,) = again.animations
    local = local_transforms(again.skeleton, animation)[1, 0]
    assert np.abs(np.linalg.norm(local[:3, :3], axis=0) - scales[1]).max() < 1e-6
