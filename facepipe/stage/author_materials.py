"""UsdPreviewSurface materials and their textures authored from parts."""

from __future__ import annotations

from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade

from facepipe.core.errors import InputError
from facepipe.core.names import unique_identifiers
from facepipe.parts import FaceParts, Material, Texture, TextureInput
from facepipe.stage.display_names import author_name

_COLORS = ("diffuse_color", "emissive_color")
_USD_NAMES = {
    "diffuse_color": "diffuseColor",
    "emissive_color": "emissiveColor",
    "metallic": "metallic",
    "roughness": "roughness",
    "opacity": "opacity",
    "opacity_threshold": "opacityThreshold",
    "occlusion": "occlusion",
    "normal": "normal",
    "ior": "ior",
    "clearcoat": "clearcoat",
    "clearcoat_roughness": "clearcoatRoughness",
}


def textures_of(parts: FaceParts) -> dict[str, Texture]:
    """Every texture of a face by name.

    :raises InputError: two different images of one name
    """
    found: dict[str, Texture] = {}
    for material in parts.materials:
        for field in _USD_NAMES:
            value = getattr(material, field)
            if isinstance(value, TextureInput):
                texture = value.texture
                if found.setdefault(texture.name, texture).data != texture.data:
                    raise InputError(material.name, f"two different textures named '{texture.name}'")
    return found


def author_materials(
    stage: Usd.Stage, scope: Sdf.Path, materials: tuple[Material, ...], textures: dict[str, str]
) -> dict[str, UsdShade.Material]:
    """Define materials under `scope`; the material by its name in parts."""
    UsdGeom.Scope.Define(stage, scope)
    names = unique_identifiers(material.name for material in materials)
    return {
        material.name: _author(stage, scope.AppendChild(name), material, textures)
        for material, name in zip(materials, names, strict=True)
    }


def _author(stage: Usd.Stage, path: Sdf.Path, material: Material, textures: dict[str, str]) -> UsdShade.Material:
    prim = UsdShade.Material.Define(stage, path)
    author_name(prim.GetPrim(), material)
    surface = UsdShade.Shader.Define(stage, path.AppendChild("Surface"))
    surface.CreateIdAttr("UsdPreviewSurface")
    prim.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
    default = Material(name="")
    for field, name in _USD_NAMES.items():
        value = getattr(material, field)
        if value == getattr(default, field):
            continue
        kind = _kind(field)
        given = surface.CreateInput(name, kind)
        if isinstance(value, TextureInput):
            texture = _author_texture(stage, path.AppendChild(f"{name}_texture"), value, field, textures)
            given.ConnectToSource(texture.ConnectableAPI(), value.channels)
        else:
            given.Set(Gf.Vec3f(*value) if field in _COLORS else float(value))
    return prim


def _kind(field: str) -> Sdf.ValueTypeName:
    if field == "normal":
        return Sdf.ValueTypeNames.Normal3f
    return Sdf.ValueTypeNames.Color3f if field in _COLORS else Sdf.ValueTypeNames.Float


def _author_texture(
    stage: Usd.Stage, path: Sdf.Path, given: TextureInput, field: str, textures: dict[str, str]
) -> UsdShade.Shader:
    reader = UsdShade.Shader.Define(stage, path.GetParentPath().AppendChild(f"{path.name}_uv"))
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set(given.uv_set)
    reader.CreateOutput("result", Sdf.ValueTypeNames.Float2)
    shader = UsdShade.Shader.Define(stage, path)
    shader.CreateIdAttr("UsdUVTexture")
    asset = textures.get(given.texture.name, given.texture.name)
    shader.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(Sdf.AssetPath(asset))
    shader.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(reader.ConnectableAPI(), "result")
    shader.CreateInput("wrapS", Sdf.ValueTypeNames.Token).Set(given.wrap_s)
    shader.CreateInput("wrapT", Sdf.ValueTypeNames.Token).Set(given.wrap_t)
    shader.CreateInput("scale", Sdf.ValueTypeNames.Float4).Set(Gf.Vec4f(*given.scale))
    shader.CreateInput("bias", Sdf.ValueTypeNames.Float4).Set(Gf.Vec4f(*given.bias))
    space = "sRGB" if field in _COLORS else "raw"
    shader.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set(space)
    kind = Sdf.ValueTypeNames.Float3 if given.channels == "rgb" else Sdf.ValueTypeNames.Float
    shader.CreateOutput(given.channels, kind)
    return shader
