"""Wrinkles of a material on the stage."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pxr import Sdf, Usd

from facepipe.core import tokens
from facepipe.core.errors import SchemaError
from facepipe.parts import Texture, TextureInput, WrinkleRegion, Wrinkles
from facepipe.stage.materials import Images, image_at
from facepipe.stage.prims import apply_schema, check_property_name, instances, put_value
from facepipe.stage.values import floats

_CHANNELS = ("r", "g", "b", "a")


def read_wrinkles(prim: Usd.Prim, images: Images) -> Wrinkles | None:
    """The wrinkles of a Material prim with their schema; None where it names no maps.

    :param images: that were read before, filled in
    :raises InputError: an image that is missing, or none
    :raises SchemaError: a channel that images don't have, or lists that are not parallel
    """
    uv_set = str(prim.GetAttribute(tokens.WRINKLES_UV_SET).Get() or "st")

    def image(name: str) -> Texture | None:
        attribute = prim.GetAttribute(name)
        return image_at(str(attribute.GetPath()), attribute, images) if attribute else None

    normal, tint = image(tokens.WRINKLES_NORMAL), image(tokens.WRINKLES_TINT)
    if normal is None or tint is None:
        return None
    regions = []
    for name in sorted(instances(prim, tokens.WRINKLE_API)):
        prefix = f"{tokens.WRINKLE_PREFIX}{name}:"
        where = f"{prim.GetPath()}.{prefix}"
        mask, channel = image(f"{prefix}mask"), str(prim.GetAttribute(f"{prefix}channel").Get() or "r")
        shapes = [str(one) for one in prim.GetAttribute(f"{prefix}shapes").Get() or ()]
        gains = floats(prim.GetAttribute(f"{prefix}gains").Get()).tolist()
        if channel not in _CHANNELS:
            raise SchemaError(f"{where}channel", f"'{channel[:40]}', expected one of {', '.join(_CHANNELS)}")
        if len(shapes) != len(gains):
            raise SchemaError(f"{where}gains", f"{len(gains)} gains and {len(shapes)} shapes, expected as many of each")
        if mask is not None:
            own: Any = channel
            read = TextureInput(texture=mask, channels=own, uv_set=uv_set)
            regions.append(WrinkleRegion(name=name, mask=read, shapes=tuple(zip(shapes, gains, strict=True))))
    return Wrinkles(
        normal=TextureInput(texture=normal, uv_set=uv_set, scale=(2.0, 2.0, 2.0, 1.0), bias=(-1.0, -1.0, -1.0, 0.0)),
        tint=TextureInput(texture=tint, uv_set=uv_set),
        regions=tuple(regions),
    )


def author_wrinkles(prim: Usd.Prim, wrinkles: Wrinkles, textures: Mapping[str, str]) -> None:
    """Put wrinkles on a Material prim.

    :param textures: asset path by texture name; names themselves where not given
    :raises InputError: the name of a region that USD can't hold
    """

    def asset(used: TextureInput) -> Sdf.AssetPath:
        return Sdf.AssetPath(textures.get(used.texture.name, used.texture.name))

    apply_schema(prim, tokens.WRINKLES_API)
    for region in wrinkles.regions:
        check_property_name(prim.GetPath(), "wrinkles", region.name, tokens.WRINKLE_API)
        apply_schema(prim, tokens.WRINKLE_API, region.name)
    put_value(prim, tokens.WRINKLES_NORMAL, asset(wrinkles.normal))
    put_value(prim, tokens.WRINKLES_TINT, asset(wrinkles.tint))
    put_value(prim, tokens.WRINKLES_UV_SET, wrinkles.normal.uv_set)
    for region in wrinkles.regions:
        prefix = f"{tokens.WRINKLE_PREFIX}{region.name}:"
        put_value(prim, f"{prefix}mask", asset(region.mask))
        put_value(prim, f"{prefix}channel", region.mask.channels)
        put_value(prim, f"{prefix}shapes", [shape for shape, _ in region.shapes])
        put_value(prim, f"{prefix}gains", [gain for _, gain in region.shapes])
