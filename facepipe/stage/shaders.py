"""Inputs of shaders, and the images that a stage names: found, read, and whether they may be copied from there."""

from __future__ import annotations

from collections.abc import Container, Iterator
from typing import Any

from pxr import Ar, Sdf, Usd, UsdShade

from facepipe.core.errors import InputError
from facepipe.core.images import is_image
from facepipe.core.policy.paths import check_copied
from facepipe.core.reading import check_regular
from facepipe.parts import Texture
from facepipe.stage.layer_files import file_of, name_of

_DEFAULT = Usd.TimeCode.Default()
_MOST_IMAGE_BYTES = 1 << 28  # of an image
Images = dict[str, bytes | None]  # by resolved path


def read_image(asset: Sdf.AssetPath) -> bytes | None:
    """The image that a value names; None where it names another file, or none.

    :raises InputError: a pipe or device, or a file that may not be read
    """
    if not asset.resolvedPath:
        return None
    file = file_of(asset.resolvedPath)
    check_regular(file, None if Ar.IsPackageRelativePath(asset.resolvedPath) else _MOST_IMAGE_BYTES)
    opened = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(asset.resolvedPath))
    data = bytes(opened.GetBuffer() or b"") if opened else b""  # an empty file has no buffer
    return data if is_image(data) else None


def copy_refusal(
    where: object, attribute: Usd.Attribute, asset: Sdf.AssetPath, time: Usd.TimeCode = _DEFAULT
) -> InputError | None:
    """Why the file that a value of an attribute names may not be copied: it is outside the roots and the folder of the
    layer that names it. A stage that is all in memory is the caller's own.
    """
    # the file of the layer that a value comes from; None where all of the stage is in memory
    layer = _layer_of_value(attribute, time)
    if layer is None or layer.anonymous:  # a repair in memory of what a file says
        below = [layer for layer in attribute.GetStage().GetLayerStack() if not layer.anonymous]
        layer = _layer_of_value(attribute, Usd.TimeCode.EarliestTime(), files=True) or next(iter(below), None)
    namer = None if layer is None else file_of(layer.realPath or layer.identifier)
    try:
        if namer is not None:
            check_copied(where, file_of(asset.resolvedPath), namer)
    except InputError as error:
        return error
    return None


def images_of(stage: Usd.Stage, known: Container[str] = ()) -> dict[str, bytes]:
    """The images that a stage names, by resolved path, but those known.

    :raises InputError: one that may not be copied
    """
    images: dict[str, bytes] = {}
    for attribute, time, asset in _asset_values(stage):
        data = None if asset.resolvedPath in known else read_image(asset)
        if data is None:
            continue
        refusal = copy_refusal(attribute.GetPath(), attribute, asset, time)
        if refusal is not None:
            raise refusal
        images[asset.resolvedPath] = data
    return images


def _asset_values(stage: Usd.Stage) -> Iterator[tuple[Usd.Attribute, Usd.TimeCode, Sdf.AssetPath]]:
    """All values of attributes that name files."""
    for top in (stage.GetPseudoRoot(), *stage.GetPrototypes()):
        for prim in Usd.PrimRange(top, Usd.PrimAllPrimsPredicate):
            for attribute in prim.GetAuthoredAttributes():
                if attribute.GetTypeName().scalarType != Sdf.ValueTypeNames.Asset:
                    continue
                for time in (_DEFAULT, *map(Usd.TimeCode, attribute.GetTimeSamples())):
                    value = attribute.Get(time)
                    for one in [value] if isinstance(value, Sdf.AssetPath) else value or ():
                        yield attribute, time, one


def _layer_of_value(attribute: Usd.Attribute, time: Usd.TimeCode, *, files: bool = False) -> Sdf.Layer | None:
    """The strongest layer with a value for a time; with `files`, of those that are not in memory alone."""
    kinds = ("default",) if time.IsDefault() else ("default", "timeSamples")
    for spec in attribute.GetPropertyStack(time):
        if any(map(spec.HasInfo, kinds)) and not (files and spec.layer.anonymous):
            return spec.layer
    return None


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
