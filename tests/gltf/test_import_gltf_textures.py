"""Textures and materials of other programs' glTF: where they lie, how they are encoded, what shines."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import done
from facepipe_gltf import read as gltf
from gltf_builder import PNG, Builder, build, make_model
from gltf_reader import read as read_gltf
from PIL import Image

from facepipe.core.errors import InputError
from facepipe.parts import FaceParts, Material, TextureInput
from facepipe.stage import save_parts
from facepipe.stage.recipes import Imported


def read(folder: Path, builder: Builder, *, strict: bool = False) -> Imported:
    (folder / "face.glb").write_bytes(builder.glb())
    return gltf.read(folder / "face.glb", gltf.Options(strict=strict))


def with_texture(data: bytes, *references: dict[str, Any], **material: Any) -> Builder:
    """The model with a picture as base colour of one material, and as its occlusion by a second reference."""
    builder = build(make_model())
    image = builder.add("images", {"bufferView": builder.view(data), "mimeType": "image/png"})
    texture = builder.add("textures", {"source": image})
    first, *others = [{"index": texture} | reference for reference in references or ({},)]
    builder.root["materials"][0] |= {"pbrMetallicRoughness": {"baseColorTexture": first}} | material
    if others:
        builder.root["materials"][0]["occlusionTexture"] = others[0]
    return builder


def placed(**place: Any) -> dict[str, Any]:
    return {"extensions": {"KHR_texture_transform": place}}


def uvs(parts: FaceParts, name: str) -> np.ndarray:
    """(n, 2) values of a set at the corners of the mesh that is textured, v down as glTF has it."""
    used = {material.name for material in parts.materials if material.textured}
    bound = [mesh for mesh in parts.meshes if mesh.material in used or {f.material for f in mesh.material_faces} & used]
    (found,) = [one for one in bound[0].uv_sets if one.name == name]
    values = np.asarray(found.values, float)
    corners = values[found.indices if found.indices is not None else bound[0].face_vertex_indices]
    return np.column_stack([corners[:, 0], 1 - corners[:, 1]])


def skin(parts: FaceParts) -> Material:
    return next(material for material in parts.materials if material.textured)


PLACES = [
    {"offset": [0.25, 0.5]},
    {"scale": [0.5, 2.0]},
    {"rotation": 0.7},
    {"offset": [0.1, -0.3], "scale": [2.0, 0.25], "rotation": -1.1},
    {"offset": [0.0, 0.0], "scale": [1 / 4095, 1 / 4095]},  # as gltfpack quantises
]


@pytest.mark.parametrize("place", PLACES)
def test_where_a_texture_lies_is_in_the_uvs(place: dict[str, Any], tmp_path: Path) -> None:
    """T R S of the extension, R = (cos sin, -sin cos): as three.js and Blender place it."""
    before = uvs(read(tmp_path, with_texture(PNG)).parts, "st")
    imported = read(tmp_path, with_texture(PNG, placed(**place)))
    used = skin(imported.parts).diffuse_color
    assert isinstance(used, TextureInput)
    assert (used.uv_set, used.uv_transform, imported.warnings) == ("st", (1, 0, 0, 0, 1, 0), ())
    angle = place.get("rotation", 0.0)
    turned = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    expected = before * place.get("scale", [1, 1]) @ turned.T + place.get("offset", [0, 0])
    np.testing.assert_allclose(uvs(imported.parts, "st"), expected, atol=1e-6)


def test_textures_that_lie_differently_read_sets_of_their_own(tmp_path: Path) -> None:
    before = uvs(read(tmp_path, with_texture(PNG)).parts, "st")
    parts = read(tmp_path, with_texture(PNG, placed(scale=[2, 2]), placed(offset=[0.5, 0]))).parts
    color, shade = skin(parts).diffuse_color, skin(parts).occlusion
    assert isinstance(color, TextureInput)
    assert isinstance(shade, TextureInput)
    assert {color.uv_set, shade.uv_set} == {"st_1", "st_2"}
    np.testing.assert_allclose(uvs(parts, color.uv_set), before * 2, atol=1e-6)
    np.testing.assert_allclose(uvs(parts, shade.uv_set), before + np.array([0.5, 0]), atol=1e-6)
    parts = read(tmp_path, with_texture(PNG, {}, placed(offset=[0.5, 0]))).parts
    np.testing.assert_allclose(uvs(parts, "st"), before, atol=1e-7)
    np.testing.assert_allclose(uvs(parts, "st_1"), before + np.array([0.5, 0]), atol=1e-6)


def test_a_mesh_does_not_get_a_set_for_each_of_countless_transforms(tmp_path: Path) -> None:
    """Each would be as large as the mesh, and costs the file a few bytes."""
    builder = with_texture(PNG)
    (given, *_), mesh = builder.root["materials"], builder.root["meshes"][0]
    builder.root["materials"] = []
    for number in range(70):
        picture = {"index": 0} | placed(offset=[number / 100, 0])
        builder.add("materials", given | {"pbrMetallicRoughness": {"baseColorTexture": picture}})
    mesh["primitives"] = [mesh["primitives"][0] | {"material": number} for number in range(70)]
    with pytest.raises(InputError, match="69 transforms of textures, expected at most 64"):
        read(tmp_path, builder)


def test_the_set_that_a_transform_names_wins(tmp_path: Path) -> None:
    builder = with_texture(PNG, placed(texCoord=1))
    for primitive in builder.root["meshes"][0]["primitives"]:
        primitive["attributes"]["TEXCOORD_1"] = primitive["attributes"]["TEXCOORD_0"]
    used = skin(read(tmp_path, builder).parts).diffuse_color
    assert isinstance(used, TextureInput)
    assert used.uv_set == "st1"


# ---- encodings


def encoded(kind: str, mode: str = "RGB", **options: Any) -> bytes:
    pixels = np.zeros((16, 16, len(mode)), np.uint8)
    pixels[:8, :, 0], pixels[8:, :, 1], pixels[..., -1] = 255, 255, 200
    written = io.BytesIO()
    Image.fromarray(pixels, mode).save(written, kind, **options)
    return written.getvalue()


@pytest.mark.parametrize("mode", ["RGB", "RGBA"])
@pytest.mark.parametrize(("kind", "extension"), [("WEBP", "EXT_texture_webp"), ("AVIF", "EXT_texture_avif")])
@pytest.mark.parametrize("required", [False, True])
def test_webp_and_avif_become_png(kind: str, extension: str, mode: str, required: bool, tmp_path: Path) -> None:
    options: dict[str, Any] = {"lossless": True} if kind == "WEBP" else {"quality": 100, "subsampling": "4:4:4"}
    builder = with_texture(PNG)
    image = builder.add("images", {"bufferView": builder.view(encoded(kind, mode, **options)), "mimeType": "x"})
    builder.root["textures"][-1] = {"extensions": {extension: {"source": image}}}
    builder.root["extensionsUsed"] = [extension]
    builder.root |= {"extensionsRequired": [extension]} if required else {}
    imported = read(tmp_path, builder)
    used = skin(imported.parts).diffuse_color
    assert imported.warnings == ()
    assert isinstance(used, TextureInput)
    shown = Image.open(io.BytesIO(used.texture.data))
    assert (shown.format, shown.mode, used.texture.name.rpartition(".")[2]) == ("PNG", mode, "png")
    expected = np.asarray(Image.open(io.BytesIO(encoded("PNG", mode))), int)
    assert np.abs(np.asarray(shown, int) - expected).max() <= (0 if kind == "WEBP" else 12)


BAD = {
    "no image": (b"GIF89a.....", "unknown type"),
    "half a WebP": (encoded("WEBP")[:40], "damaged"),
    "half a PNG": (encoded("PNG")[:-20], "is cut short"),
    "a PNG with other pixels than it says": (encoded("PNG").replace(b"IDAT", b"IDAT\0", 1), "checksum is wrong"),
    "half a JPEG": (encoded("JPEG")[:-20], "is cut short"),
    "KTX2": (b"\xabKTX 20\xbb\r\n\x1a\n" + bytes(80), "KTX2 image, expected PNG"),
    "a wrong AVIF": (b"\0\0\0\x20ftypavif" + bytes(40), ""),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_texture_costs_the_texture_alone(name: str, tmp_path: Path) -> None:
    data, why = BAD[name]
    imported = read(tmp_path, with_texture(data))
    whole = read(tmp_path, with_texture(PNG)).parts
    assert any("images[" in line and why in line and line.endswith(": left out") for line in imported.warnings)
    assert not any(material.textured for material in imported.parts.materials)
    assert [len(mesh.points) for mesh in imported.parts.meshes] == [len(mesh.points) for mesh in whole.meshes]
    with pytest.raises(InputError, match="images"):
        read(tmp_path, with_texture(data), strict=True)


def test_a_picture_that_is_not_there_costs_the_texture_alone(tmp_path: Path) -> None:
    builder = with_texture(PNG)
    builder.root["images"][-1] = {"uri": "skin.png"}
    imported = read(tmp_path, builder)
    assert any("'skin.png' can't be found: left out" in line for line in imported.warnings)
    with pytest.raises(InputError, match="can't be found"):
        read(tmp_path, builder, strict=True)


# ---- materials


def glossy(**values: Any) -> dict[str, Any]:
    return {"extensions": {"KHR_materials_pbrSpecularGlossiness": values}}


def test_specular_glossiness_becomes_metallic_roughness(tmp_path: Path) -> None:
    """By the factors of known materials: what reflects 4 % is no metal, what has no colour but its shine is one."""
    for diffuse, specular, gloss, color, metal, rough in (
        ([0.6, 0.4, 0.3, 1], [0.04] * 3, 0.3, (0.6, 0.4, 0.3), 0, 0.7),
        ([0, 0, 0, 1], [1.0, 0.8, 0.3], 0.9, (1.0, 0.8, 0.3), 1, 0.1),
    ):
        builder = build(make_model())
        factors = {"diffuseFactor": diffuse, "specularFactor": specular, "glossinessFactor": gloss}
        builder.root["materials"][0] |= glossy(**factors)
        material = read(tmp_path, builder).parts.materials[0]
        np.testing.assert_allclose(material.diffuse_color, color, atol=0.03)  # type: ignore[arg-type]
        np.testing.assert_allclose([material.metallic, material.roughness], [metal, rough], atol=0.03)  # type: ignore[list-item]


def test_pictures_of_specular_glossiness(tmp_path: Path) -> None:
    builder = with_texture(PNG)
    texture = {"index": len(builder.root["textures"]) - 1}
    del builder.root["materials"][0]["pbrMetallicRoughness"]
    builder.root["materials"][0] |= glossy(
        diffuseTexture=texture, specularGlossinessTexture=texture, glossinessFactor=0.5, diffuseFactor=[1, 0.5, 1, 1]
    )
    imported = read(tmp_path, builder)
    material = skin(imported.parts)
    color, rough = material.diffuse_color, material.roughness
    assert isinstance(color, TextureInput)
    assert isinstance(rough, TextureInput)
    assert (color.scale[:3], material.metallic) == ((1, 0.5, 1), 0.0)
    assert (rough.channels, rough.scale[3], rough.bias[3]) == ("a", -0.5, 1.0)
    assert any("its specular colour is left out" in line for line in imported.warnings)


def test_unlit_stays_unlit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    builder = build(make_model())
    builder.root["materials"][0] |= {"extensions": {"KHR_materials_unlit": {}}}
    imported = read(tmp_path, builder)
    assert imported.warnings == ()
    assert [material.unlit for material in imported.parts.materials] == [True, False][: len(imported.parts.materials)]
    save_parts(imported.parts, tmp_path / "face.usda")
    done(capsys, "export", tmp_path / "face.usda", "-o", tmp_path / "out.glb", quiet=False)
    written = read_gltf(tmp_path / "out.glb").json
    assert "KHR_materials_unlit" in written["extensionsUsed"]
    lit = {one["name"]: "KHR_materials_unlit" not in one.get("extensions", {}) for one in written["materials"]}
    assert sorted(lit.values())[0] is False
    assert sum(not value for value in lit.values()) == 1
