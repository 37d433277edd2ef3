"""Inputs of shaders: the values, and the images that they name."""

from __future__ import annotations

from typing import Any

from pxr import Sdf, Usd, UsdShade

from facepipe.core.errors import InputError
from facepipe.parts import Texture
from facepipe.stage.assets import copy_refusal, name_of, read_image

Images = dict[str, bytes | None]  # by resolved path


def value_of(shader: UsdShade.Shader, name: str, otherwise: Any) -> Any:
    attribute = attribute_of(shader, name)
    value = attribute.Get() if attribute else None
    return otherwise if value is None else value


def attribute_of(shader: UsdShade.Shader, name: str) -> Usd.Attribute | None:
    """The attribute that an input takes its value from."""
    given = shader.GetInput(name)
    attributes = UsdShade.Utils.GetValueProducingAttributes(given) if given else []
    return attributes[0] if attributes else None


def four(value: Any) -> tuple[float, float, float, float]:
    red, green, blue, alpha = value
    return (float(red), float(green), float(blue), float(alpha))


def image_of(source: UsdShade.Shader, images: Images) -> Texture | None:
    """The image of a shader that reads one; None where it names none.

    :param images: that were read before, filled in
    :raises InputError: missing, tiles, or no image
    """
    file = attribute_of(source, "file")
    asset = file.Get() if file else None
    if asset is None:
        return None
    where = f"{source.GetPath()}.inputs:file"
    if not isinstance(asset, Sdf.AssetPath):
        raise InputError(where, f"value of type {type(asset).__name__}, expected an asset path")
    if asset.resolvedPath not in images:
        images[asset.resolvedPath] = read_image(asset)
    data = images[asset.resolvedPath]
    if data is None:
        missing = not asset.resolvedPath
        if "<UDIM>" in asset.path:
            what = "UDIM tiles: a face has one picture an input, so bake them into one, or name one tile"
            raise InputError(where, f"@{asset.path}@ are {what}")
        raise InputError(where, f"texture @{asset.path}@ can't be found" if missing else f"@{asset.path}@ is no image")
    # a face with an image that may not be copied can be read all the same: who writes the image raises the refusal
    refusal = copy_refusal(where, file, asset)
    return Texture(name=name_of(asset.resolvedPath), data=b"" if refusal else data, refusal=refusal)
