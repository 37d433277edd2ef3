"""UsdPreviewSurface materials of a stage as parts."""

from __future__ import annotations

from typing import Any, Literal

from pxr import Sdf, Usd, UsdShade

from facepipe.core.errors import InputError
from facepipe.parts import Color, Material, Texture, TextureInput
from facepipe.stage.assets import copy_refusal, name_of, read_image
from facepipe.stage.display_names import label
from facepipe.stage.guard import reads_prim

Wrap = Literal["repeat", "mirror", "clamp"]
_WRAPS: dict[str, Wrap] = {
    "repeat": "repeat",
    "mirror": "mirror",
    "clamp": "clamp",
    "black": "clamp",
    "useMetadata": "repeat",
}


@reads_prim
def read_material(prim: Usd.Prim, name: str) -> Material | None:
    """The UsdPreviewSurface of a Material prim; None where it has none.

    :raises InputError: a texture that is missing or no image
    """
    surface, _, _ = UsdShade.Material(prim).ComputeSurfaceSource()
    if not surface or surface.GetShaderId() != "UsdPreviewSurface":
        return None
    return Material(
        name=name,
        diffuse_color=_color(surface, "diffuseColor", (0.18, 0.18, 0.18)),
        emissive_color=_color(surface, "emissiveColor", (0.0, 0.0, 0.0)),
        metallic=_number(surface, "metallic", 0.0),
        roughness=_number(surface, "roughness", 0.5),
        opacity=_number(surface, "opacity", 1.0),
        opacity_threshold=float(_value(surface, "opacityThreshold", 0.0)),
        occlusion=_number(surface, "occlusion", 1.0),
        normal=_texture(surface, "normal"),
        ior=float(_value(surface, "ior", 1.5)),
        clearcoat=_number(surface, "clearcoat", 0.0),
        clearcoat_roughness=_number(surface, "clearcoatRoughness", 0.01),
        label=label(prim, name),
    )


def _value(shader: UsdShade.Shader, name: str, otherwise: Any) -> Any:
    attribute = _attribute(shader, name)
    value = attribute.Get() if attribute else None
    return otherwise if value is None else value


def _attribute(shader: UsdShade.Shader, name: str) -> Usd.Attribute | None:
    """The attribute that an input takes its value from."""
    given = shader.GetInput(name)
    attributes = UsdShade.Utils.GetValueProducingAttributes(given) if given else []
    return attributes[0] if attributes else None


def _color(shader: UsdShade.Shader, name: str, otherwise: Color) -> Color | TextureInput:
    textured = _texture(shader, name)
    if textured:
        return textured
    red, green, blue = _value(shader, name, otherwise)
    return (float(red), float(green), float(blue))


def _number(shader: UsdShade.Shader, name: str, otherwise: float) -> float | TextureInput:
    return _texture(shader, name) or float(_value(shader, name, otherwise))


def _texture(shader: UsdShade.Shader, name: str) -> TextureInput | None:
    given = _attribute(shader, name)
    if given is None or UsdShade.Utils.GetType(given.GetName()) != UsdShade.AttributeType.Output:
        return None
    source = UsdShade.Shader(given.GetPrim())
    if source.GetShaderId() != "UsdUVTexture":
        return None
    file = _attribute(source, "file")
    asset = file.Get() if file else None
    if asset is None:
        return None
    return TextureInput(
        texture=_image(source, file, asset),
        channels=given.GetName().rpartition(":")[2],
        uv_set=_uv_set(source),
        scale=_four(_value(source, "scale", (1, 1, 1, 1))),
        bias=_four(_value(source, "bias", (0, 0, 0, 0))),
        wrap_s=_WRAPS.get(str(_value(source, "wrapS", "repeat")), "repeat"),
        wrap_t=_WRAPS.get(str(_value(source, "wrapT", "repeat")), "repeat"),
    )


def _four(value: Any) -> tuple[float, float, float, float]:
    red, green, blue, alpha = value
    return (float(red), float(green), float(blue), float(alpha))


def _uv_set(texture: UsdShade.Shader) -> str:
    given = _attribute(texture, "st")
    if given:
        reader = UsdShade.Shader(given.GetPrim())
        if reader.GetShaderId() == "UsdTransform2d":
            return _uv_set_of_transform(reader)
        return str(_value(reader, "varname", "st"))
    return "st"


def _uv_set_of_transform(transform: UsdShade.Shader) -> str:
    given = _attribute(transform, "in")
    return str(_value(UsdShade.Shader(given.GetPrim()), "varname", "st")) if given else "st"


def _image(shader: UsdShade.Shader, file: Usd.Attribute, asset: Any) -> Texture:
    where = f"{shader.GetPath()}.inputs:file"
    if not isinstance(asset, Sdf.AssetPath):
        raise InputError(where, f"value of type {type(asset).__name__}, expected an asset path")
    data = read_image(asset)
    if data is None:
        missing = not asset.resolvedPath
        raise InputError(where, f"texture @{asset.path}@ can't be found" if missing else f"@{asset.path}@ is no image")
    name, refusal = name_of(asset.resolvedPath), copy_refusal(where, file, asset)
    return Texture(name=name, data=b"" if refusal else data, refusal=refusal)
