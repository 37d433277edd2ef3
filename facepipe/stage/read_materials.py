"""UsdPreviewSurface materials of a stage as parts."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from pxr import Ar, Sdf, Usd, UsdShade

from facepipe.errors import InputError
from facepipe.parts import Color, Material, Texture, TextureInput
from facepipe.stage.display_names import label
from facepipe.stage.guard import reads_prim
from facepipe.stage.textures import is_image

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
        label=label(prim, name),
    )


def _value(shader: UsdShade.Shader, name: str, otherwise: Any) -> Any:
    given = shader.GetInput(name)
    if not given:
        return otherwise
    attributes = UsdShade.Utils.GetValueProducingAttributes(given)
    value = attributes[0].Get() if attributes else None
    return otherwise if value is None else value


def _color(shader: UsdShade.Shader, name: str, otherwise: Color) -> Color | TextureInput:
    textured = _texture(shader, name)
    if textured:
        return textured
    red, green, blue = _value(shader, name, otherwise)
    return (float(red), float(green), float(blue))


def _number(shader: UsdShade.Shader, name: str, otherwise: float) -> float | TextureInput:
    return _texture(shader, name) or float(_value(shader, name, otherwise))


def _texture(shader: UsdShade.Shader, name: str) -> TextureInput | None:
    given = shader.GetInput(name)
    attributes = UsdShade.Utils.GetValueProducingAttributes(given) if given else []
    if not attributes or UsdShade.Utils.GetType(attributes[0].GetName()) != UsdShade.AttributeType.Output:
        return None
    source = UsdShade.Shader(attributes[0].GetPrim())
    if source.GetShaderId() != "UsdUVTexture":
        return None
    asset = _value(source, "file", None)
    if asset is None:
        return None
    return TextureInput(
        texture=_image(source, asset),
        channels=attributes[0].GetName().rpartition(":")[2],
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
    given = texture.GetInput("st")
    attributes = UsdShade.Utils.GetValueProducingAttributes(given) if given else []
    if attributes:
        reader = UsdShade.Shader(attributes[0].GetPrim())
        if reader.GetShaderId() == "UsdTransform2d":
            return _uv_set_of_transform(reader)
        return str(_value(reader, "varname", "st"))
    return "st"


def _uv_set_of_transform(transform: UsdShade.Shader) -> str:
    attributes = UsdShade.Utils.GetValueProducingAttributes(transform.GetInput("in"))
    return str(_value(UsdShade.Shader(attributes[0].GetPrim()), "varname", "st")) if attributes else "st"


def _image(shader: UsdShade.Shader, asset: Any) -> Texture:
    where = f"{shader.GetPath()}.inputs:file"
    if not isinstance(asset, Sdf.AssetPath):
        raise InputError(where, f"value of type {type(asset).__name__}, expected an asset path")
    resolved = asset.resolvedPath
    opened = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(resolved)) if resolved else None
    if not opened:
        raise InputError(where, f"texture @{asset.path}@ can't be found")
    data = bytes(opened.GetBuffer())
    if not is_image(data):
        raise InputError(where, f"@{asset.path}@ is no image")
    return Texture(name=Path(Ar.SplitPackageRelativePathInner(resolved)[1] or resolved).name, data=data)
