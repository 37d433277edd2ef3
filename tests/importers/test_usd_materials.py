"""Materials of other programs' stages: textures that are moved, and surfaces of MaterialX."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from faces import replace_mesh, tiny_face
from foreign_stages import foreign_stage, read, warned, written
from gltf_builder import PNG
from pxr import Gf, Sdf, Usd, UsdShade

from facepipe.core.errors import InputError
from facepipe.parts import Material, TextureInput, UvSet
from facepipe.stage.recipes import Imported

Names = Sdf.ValueTypeNames
UVS = np.random.default_rng(3).random((60, 2))


def stage_with(folder: Path, build: Callable[[Usd.Stage, UsdShade.Material], object]) -> Path:
    """A foreign stage whose first mesh has a material that `build` makes, and UVs `st` of `UVS`."""
    parts = tiny_face()
    mesh = parts.meshes[0]
    values = UVS[: len(mesh.points)].astype(np.float32)
    mesh = replace_mesh(mesh, uv_sets=(UvSet(values=values),), material="Skin", material_faces=())
    stage = foreign_stage(replace(parts, meshes=(mesh,), materials=(Material(name="Skin"),)))
    old = next(prim for prim in stage.Traverse() if prim.IsA(UsdShade.Material))
    for child in old.GetAllChildren():
        stage.RemovePrim(child.GetPath())
    for one in old.GetAuthoredProperties():
        old.RemoveProperty(one.GetName())
    build(stage, UsdShade.Material(old))
    (folder / "skin.png").write_bytes(PNG)
    return written(stage, folder / "face.usda")


def shader(stage: Usd.Stage, material: UsdShade.Material, name: str, kind: str) -> UsdShade.Shader:
    made = UsdShade.Shader.Define(stage, material.GetPath().AppendChild(name))
    made.CreateIdAttr(kind)
    return made


def textured(
    stage: Usd.Stage, material: UsdShade.Material, *transforms: tuple[tuple[float, float], float, tuple[float, float]]
) -> None:
    """A UsdPreviewSurface whose colour is a texture behind transforms, the last nearest to the UVs."""
    surface = shader(stage, material, "Surface", "UsdPreviewSurface")
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", Names.Token))
    texture = shader(stage, material, "Texture", "UsdUVTexture")
    texture.CreateInput("file", Names.Asset).Set(Sdf.AssetPath("./skin.png"))
    surface.CreateInput("diffuseColor", Names.Color3f).ConnectToSource(texture.CreateOutput("rgb", Names.Float3))
    given = texture.CreateInput("st", Names.Float2)
    for number, (scale, degrees, offset) in enumerate(transforms):
        moved = shader(stage, material, f"Place{number}", "UsdTransform2d")
        moved.CreateInput("scale", Names.Float2).Set(Gf.Vec2f(*scale))
        moved.CreateInput("rotation", Names.Float).Set(degrees)
        moved.CreateInput("translation", Names.Float2).Set(Gf.Vec2f(*offset))
        given.ConnectToSource(moved.CreateOutput("result", Names.Float2))
        given = moved.CreateInput("in", Names.Float2)
    reader = shader(stage, material, "Reader", "UsdPrimvarReader_float2")
    reader.CreateInput("varname", Names.String).Set("st")
    given.ConnectToSource(reader.CreateOutput("result", Names.Float2))


def uvs(imported: Imported) -> np.ndarray:
    mesh = imported.parts.meshes[0]
    return np.asarray(next(one for one in mesh.uv_sets if one.name == "st").values, float)


def turned(values: np.ndarray, degrees: float) -> np.ndarray:
    """Counter-clockwise about the origin."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return values @ np.array([[c, -s], [s, c]]).T


def test_transforms_before_a_texture_are_in_the_uvs(tmp_path: Path) -> None:
    """UsdTransform2d: ``in * scale * rotate + translation``."""
    first, second = ((0.5, 2.0), 30.0, (0.5, 0.25)), ((1.5, 1.0), -70.0, (0.0, -0.5))
    imported = read(stage_with(tmp_path, lambda stage, material: textured(stage, material, first, second)))
    own = UVS[: len(uvs(imported))]
    inner = turned(own * second[0], second[1]) + second[2]
    expected = turned(inner * first[0], first[1]) + first[2]
    np.testing.assert_allclose(uvs(imported), expected, atol=1e-6)
    assert not any("transform" in line for line in imported.warnings)


def test_tiles_are_named(tmp_path: Path) -> None:
    def tiles(stage: Usd.Stage, material: UsdShade.Material) -> None:
        textured(stage, material)
        node = UsdShade.Shader(stage.GetPrimAtPath(material.GetPath().AppendChild("Texture")))
        node.GetInput("file").Set(Sdf.AssetPath("./skin.<UDIM>.png"))

    path = stage_with(tmp_path, tiles)
    warned(read(path), "UDIM tiles: a face has one picture an input")
    with pytest.raises(InputError, match="UDIM tiles"):
        read(path, strict=True)  # type: ignore[arg-type]


def test_a_damaged_texture_costs_the_texture_alone(tmp_path: Path) -> None:
    path = stage_with(tmp_path, textured)
    (tmp_path / "skin.png").write_bytes(PNG[:-6])
    imported = read(path)
    warned(imported, "skin.png is cut short")
    warned(imported, "left out")
    assert [material.textured for material in imported.parts.materials] == [{}]
    with pytest.raises(InputError, match=r"skin\.png"):
        read(path, strict=True)  # type: ignore[arg-type]


def surface(stage: Usd.Stage, material: UsdShade.Material, kind: str, **inputs: object) -> UsdShade.Shader:
    node = shader(stage, material, "Surface", kind)
    material.CreateSurfaceOutput("mtlx").ConnectToSource(node.CreateOutput("out", Names.Token))
    for name, value in inputs.items():
        color = isinstance(value, tuple)
        node.CreateInput(name, Names.Color3f if color else Names.Float).Set(Gf.Vec3f(*value) if color else value)  # type: ignore[misc]
    return node


SKIN = (0.8, 0.5, 0.4)
SURFACES: dict[str, tuple[dict[str, object], dict[str, object]]] = {
    "ND_standard_surface_surfaceshader": (
        {
            "base": 0.5,
            "base_color": SKIN,
            "specular_roughness": 0.35,
            "metalness": 0.25,
            "coat": 0.5,
            "specular_IOR": 1.4,
        },
        {"diffuse_color": (0.4, 0.25, 0.2), "roughness": 0.35, "metallic": 0.25, "clearcoat": 0.5, "ior": 1.4},
    ),
    "ND_open_pbr_surface_surfaceshader": (
        {"base_color": SKIN, "specular_roughness": 0.35, "geometry_opacity": 0.5, "coat_weight": 0.25},
        {"diffuse_color": SKIN, "roughness": 0.35, "opacity": 0.5, "clearcoat": 0.25, "metallic": 0.0},
    ),
    "ND_gltf_pbr_surfaceshader": (
        {"base_color": SKIN, "roughness": 0.35, "metallic": 0.0, "emissive": (0.1, 0.2, 0.3), "emissive_strength": 2.0},
        {"diffuse_color": SKIN, "roughness": 0.35, "metallic": 0.0, "emissive_color": (0.2, 0.4, 0.6)},
    ),
    "ND_UsdPreviewSurface_surfaceshader": (
        {"diffuseColor": SKIN, "roughness": 0.35},
        {"diffuse_color": SKIN, "roughness": 0.35, "metallic": 0.0},
    ),
}


@pytest.mark.parametrize("kind", SURFACES)
def test_surfaces_of_materialx(kind: str, tmp_path: Path) -> None:
    inputs, expected = SURFACES[kind]
    imported = read(stage_with(tmp_path, lambda stage, material: surface(stage, material, kind, **inputs)))
    assert not any("material" in line for line in imported.warnings)
    (material,) = imported.parts.materials
    for field, value in expected.items():
        np.testing.assert_allclose(getattr(material, field), value, atol=1e-6, err_msg=field)


def image(stage: Usd.Stage, material: UsdShade.Material, kind: str = "ND_image_color3") -> UsdShade.Output:
    node = shader(stage, material, "Image", kind)
    node.CreateInput("file", Names.Asset).Set(Sdf.AssetPath("./skin.png"))
    node.CreateInput("uaddressmode", Names.String).Set("mirror")
    place = shader(stage, material, "Place", "ND_place2d_vector2")
    place.CreateInput("scale", Names.Float2).Set(Gf.Vec2f(2.0, 0.5))
    place.CreateInput("offset", Names.Float2).Set(Gf.Vec2f(0.25, 0.5))
    node.CreateInput("texcoord", Names.Float2).ConnectToSource(place.CreateOutput("out", Names.Float2))
    reader = shader(stage, material, "Reader", "ND_geompropvalue_vector2")
    reader.CreateInput("geomprop", Names.String).Set("st")
    place.CreateInput("texcoord", Names.Float2).ConnectToSource(reader.CreateOutput("out", Names.Float2))
    return node.CreateOutput("out", Names.Color3f)


def test_images_and_normals_of_materialx(tmp_path: Path) -> None:
    def make(stage: Usd.Stage, material: UsdShade.Material) -> None:
        node = surface(stage, material, "ND_standard_surface_surfaceshader")
        shown = image(stage, material)
        tinted = shader(stage, material, "Tint", "ND_multiply_color3")
        tinted.CreateInput("in1", Names.Color3f).ConnectToSource(shown)
        tinted.CreateInput("in2", Names.Color3f).Set(Gf.Vec3f(0.5, 1.0, 0.25))
        node.CreateInput("base_color", Names.Color3f).ConnectToSource(tinted.CreateOutput("out", Names.Color3f))
        bump = shader(stage, material, "Bump", "ND_normalmap")
        bump.CreateInput("in", Names.Vector3f).ConnectToSource(shown)
        node.CreateInput("normal", Names.Vector3f).ConnectToSource(bump.CreateOutput("out", Names.Vector3f))

    imported = read(stage_with(tmp_path, make))
    (material,) = imported.parts.materials
    color, normal = material.diffuse_color, material.normal
    assert isinstance(color, TextureInput)
    assert isinstance(normal, TextureInput)
    assert (color.scale[:3], color.wrap_s, color.texture.data) == ((0.5, 1.0, 0.25), "mirror", PNG)
    assert (normal.scale[:3], normal.bias[:3]) == ((2, 2, 2), (-1, -1, -1))
    np.testing.assert_allclose(uvs(imported), UVS[: len(uvs(imported))] / (2.0, 0.5) - (0.25, 0.5), atol=1e-6)


@pytest.mark.parametrize("there", [False, True])
def test_a_materialx_file_is_named_and_the_rest_read(there: bool, tmp_path: Path) -> None:
    def make(stage: Usd.Stage, material: UsdShade.Material) -> None:
        material.GetPrim().GetReferences().AddReference("./skin.mtlx", "/MaterialX/Materials/Skin")

    path = stage_with(tmp_path, make)
    if there:
        (tmp_path / "skin.mtlx").write_text('<?xml version="1.0"?><materialx version="1.38"></materialx>')
    imported = read(path)
    warned(imported, "skin.mtlx: MaterialX files are not read, only materials authored as UsdShade")
    assert len(imported.parts.meshes) == 1


def test_what_materialx_mixes_is_named(tmp_path: Path) -> None:
    def make(stage: Usd.Stage, material: UsdShade.Material) -> None:
        node = surface(stage, material, "ND_standard_surface_surfaceshader", subsurface=0.5)
        noise = shader(stage, material, "Noise", "ND_noise2d_color3")
        node.CreateInput("base_color", Names.Color3f).ConnectToSource(noise.CreateOutput("out", Names.Color3f))

    warned(read(stage_with(tmp_path, make)), "subsurface, base_color (of nodes that mix) of the material: left out")


def test_nodes_in_a_circle_end(tmp_path: Path) -> None:
    """A circle of nodes ends."""

    def make(stage: Usd.Stage, material: UsdShade.Material) -> None:
        node = surface(stage, material, "ND_standard_surface_surfaceshader")
        first, second = (shader(stage, material, name, "ND_convert_color3_color3") for name in ("A", "B"))
        first.CreateInput("in", Names.Color3f).ConnectToSource(second.CreateOutput("out", Names.Color3f))
        second.CreateInput("in", Names.Color3f).ConnectToSource(first.CreateOutput("out", Names.Color3f))
        node.CreateInput("base_color", Names.Color3f).ConnectToSource(first.GetOutput("out"))

    warned(read(stage_with(tmp_path, make)), "base_color (of nodes that mix)")
