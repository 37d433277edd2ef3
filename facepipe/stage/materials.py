"""UsdPreviewSurface materials of a stage: read as parts, and authored from them."""

from __future__ import annotations

from typing import Literal

from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade

from facepipe.core import tokens
from facepipe.core.errors import InputError
from facepipe.core.names import unique_identifiers
from facepipe.parts import Color, FaceParts, Material, Texture, TextureInput, UvTransform
from facepipe.stage.api_schemas import put
from facepipe.stage.guard import reads_prim
from facepipe.stage.materialx import read_materialx
from facepipe.stage.prims import author_name, editable, label
from facepipe.stage.shaders import Images, attribute_of, four, image_of, value_of
from facepipe.stage.uv_transforms import IDENTITY, composed, scaled_turned_moved

Wrap = Literal["repeat", "mirror", "clamp"]
_WRAPS: dict[str, Wrap] = {
    "repeat": "repeat",
    "mirror": "mirror",
    "clamp": "clamp",
    "black": "clamp",
    "useMetadata": "repeat",
}
_MOST_TRANSFORMS = 16  # one after another: a circle has no end


@reads_prim
def read_material(prim: Usd.Prim, name: str, images: Images) -> Material | None:
    """The UsdPreviewSurface of a Material prim, else what MaterialX says of it; None where it has neither.

    :param images: that were read before, filled in: one that many materials name is read once

    :raises InputError: a texture that is missing or no image
    """
    surface, _, _ = UsdShade.Material(prim).ComputeSurfaceSource()
    if not surface or surface.GetShaderId() != "UsdPreviewSurface":
        return read_materialx(prim, name, images)
    # what is not authored has the default of the UsdPreviewSurface specification
    return Material(
        name=name,
        diffuse_color=_color(surface, "diffuseColor", (0.18, 0.18, 0.18), images),
        emissive_color=_color(surface, "emissiveColor", (0.0, 0.0, 0.0), images),
        metallic=_number(surface, "metallic", 0.0, images),
        roughness=_number(surface, "roughness", 0.5, images),
        opacity=_number(surface, "opacity", 1.0, images),
        opacity_threshold=float(value_of(surface, "opacityThreshold", 0.0)),
        occlusion=_number(surface, "occlusion", 1.0, images),
        normal=_texture(surface, "normal", images),
        ior=float(value_of(surface, "ior", 1.5)),
        clearcoat=_number(surface, "clearcoat", 0.0, images),
        clearcoat_roughness=_number(surface, "clearcoatRoughness", 0.01, images),
        unlit=bool(prim.GetCustomDataByKey(tokens.UNLIT)),
        label=label(prim, name),
    )


def _color(shader: UsdShade.Shader, name: str, otherwise: Color, images: Images) -> Color | TextureInput:
    textured = _texture(shader, name, images)
    if textured:
        return textured
    red, green, blue = value_of(shader, name, otherwise)
    return (float(red), float(green), float(blue))


def _number(shader: UsdShade.Shader, name: str, otherwise: float, images: Images) -> float | TextureInput:
    return _texture(shader, name, images) or float(value_of(shader, name, otherwise))


def _texture(shader: UsdShade.Shader, name: str, images: Images) -> TextureInput | None:
    given = attribute_of(shader, name)
    if given is None or UsdShade.Utils.GetType(given.GetName()) != UsdShade.AttributeType.Output:
        return None
    source = UsdShade.Shader(given.GetPrim())
    if source.GetShaderId() != "UsdUVTexture":
        return None
    texture = image_of(source, images)
    if texture is None:
        return None
    uv_set, transform = _uv_set(source)
    return TextureInput(
        texture=texture,
        channels=given.GetName().rpartition(":")[2],
        uv_set=uv_set,
        uv_transform=transform,
        scale=four(value_of(source, "scale", (1, 1, 1, 1))),
        bias=four(value_of(source, "bias", (0, 0, 0, 0))),
        wrap_s=_WRAPS.get(str(value_of(source, "wrapS", "repeat")), "repeat"),
        wrap_t=_WRAPS.get(str(value_of(source, "wrapT", "repeat")), "repeat"),
    )


def _uv_set(shader: UsdShade.Shader) -> tuple[str, UvTransform]:
    """The UV set that a texture reads, and what transforms before it do to it."""
    transform, name = IDENTITY, "st"
    for _ in range(_MOST_TRANSFORMS):
        given = attribute_of(shader, name)
        if not given:
            return "st", transform
        shader = UsdShade.Shader(given.GetPrim())
        if shader.GetShaderId() != "UsdTransform2d":
            break
        (x, y), (u, v) = value_of(shader, "scale", (1, 1)), value_of(shader, "translation", (0, 0))
        own = scaled_turned_moved((float(x), float(y)), float(value_of(shader, "rotation", 0.0)), (float(u), float(v)))
        transform, name = composed(transform, own), "in"
    return str(value_of(shader, "varname", "st")), transform


_COLOR_FIELDS = ("diffuse_color", "emissive_color")
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
    textures: dict[str, Texture] = {}
    for material in parts.materials:
        for used in material.textured.values():
            if textures.setdefault(used.texture.name, used.texture).data != used.texture.data:
                raise InputError(material.name, f"two different textures named '{used.texture.name}'")
    return textures


def author_texture(material: Usd.Prim, field: str, path: str) -> None:
    """Put another image in place of the texture of a material's input; one of colours is read as it is.

    :param field: of `Material`
    :param path: asset path of the image
    :raises InputError: the input is no texture
    """
    surface, _, _ = UsdShade.Material(material).ComputeSurfaceSource()
    given = attribute_of(surface, _USD_NAMES[field]) if surface else None
    shader = UsdShade.Shader(editable(given.GetPrim())) if given else None
    if not shader or shader.GetShaderId() != "UsdUVTexture":
        raise InputError(material.GetPath(), f"no texture of its {_USD_NAMES[field]}, expected one")
    put(shader.CreateInput("file", Sdf.ValueTypeNames.Asset).GetAttr(), Sdf.AssetPath(path))
    if field not in _COLOR_FIELDS:
        return
    for name, neutral in (("scale", 1.0), ("bias", 0.0)):
        if shader.GetInput(name):
            put(shader.GetInput(name).GetAttr(), Gf.Vec4f(neutral))


def author_opacity(material: Usd.Prim, opacity: float) -> None:
    """Put one number in place of what a material's opacity was."""
    surface, _, _ = UsdShade.Material(material).ComputeSurfaceSource()
    given = UsdShade.Shader(editable(surface.GetPrim())).CreateInput("opacity", Sdf.ValueTypeNames.Float)
    given.DisconnectSource()
    put(given.GetAttr(), float(opacity))


def author_color_scale(material: Usd.Prim, scale: tuple[float, float, float, float]) -> None:
    """What the texture of a material's colour is multiplied with."""
    surface, _, _ = UsdShade.Material(material).ComputeSurfaceSource()
    given = attribute_of(surface, "diffuseColor")
    if given is None:
        return
    shader = UsdShade.Shader(editable(given.GetPrim()))
    put(shader.CreateInput("scale", Sdf.ValueTypeNames.Float4).GetAttr(), Gf.Vec4f(*scale))


def author_materials(
    stage: Usd.Stage, scope: Sdf.Path, materials: tuple[Material, ...], textures: dict[str, str]
) -> dict[str, UsdShade.Material]:
    """Define materials under `scope`; the material by its name in parts."""
    UsdGeom.Scope.Define(stage, scope)
    names = unique_identifiers(material.name for material in materials)
    default, prims = Material(name=""), {}
    for material, own in zip(materials, names, strict=True):
        path = scope.AppendChild(own)
        prim = UsdShade.Material.Define(stage, path)
        author_name(prim.GetPrim(), material)
        if material.unlit:
            prim.GetPrim().SetCustomDataByKey(tokens.UNLIT, True)
        surface = UsdShade.Shader.Define(stage, path.AppendChild("Surface"))
        surface.CreateIdAttr("UsdPreviewSurface")
        prim.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
        for field, name in _USD_NAMES.items():
            value = getattr(material, field)
            if value == getattr(default, field):
                continue  # the shader has the same
            kind = Sdf.ValueTypeNames.Normal3f if field == "normal" else Sdf.ValueTypeNames.Float
            given = surface.CreateInput(name, Sdf.ValueTypeNames.Color3f if field in _COLOR_FIELDS else kind)
            if isinstance(value, TextureInput):
                texture = _author_texture(stage, path.AppendChild(f"{name}_texture"), value, field, textures)
                given.ConnectToSource(texture.ConnectableAPI(), value.channels)
            else:
                given.Set(Gf.Vec3f(*value) if field in _COLOR_FIELDS else float(value))
        prims[material.name] = prim
    return prims


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
    # numbers are not colours: read as sRGB, a roughness of 0.5 would be 0.21
    space = "sRGB" if field in _COLOR_FIELDS else "raw"
    shader.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set(space)
    kind = Sdf.ValueTypeNames.Float3 if given.channels == "rgb" else Sdf.ValueTypeNames.Float
    shader.CreateOutput(given.channels, kind)
    return shader
