"""Images that a stage names: found, read, and whether they may be copied from there."""

from __future__ import annotations

from collections.abc import Container, Iterator
from pathlib import Path

from pxr import Ar, Sdf, Usd

from facepipe.core.errors import InputError
from facepipe.core.images import is_image
from facepipe.core.policy.paths import check_copied
from facepipe.core.reading import check_regular

_DEFAULT = Usd.TimeCode.Default()
_MOST_IMAGE_BYTES = 1 << 28  # of an image


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
    layer = _layer(attribute, time)
    if layer is None or layer.anonymous:  # a repair in memory of what a file says
        below = [layer for layer in attribute.GetStage().GetLayerStack() if not layer.anonymous]
        layer = _layer(attribute, Usd.TimeCode.EarliestTime(), files=True) or next(iter(below), None)
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


def file_of(path: str) -> Path:
    """The file that a resolved path is in: the outer package, where it is packed."""
    return Path(Ar.SplitPackageRelativePathOuter(path)[0])


def name_of(path: str) -> str:
    """The file name of a resolved path, that in the package, where it is packed."""
    return Path(Ar.SplitPackageRelativePathInner(path)[1] or path).name


def _layer(attribute: Usd.Attribute, time: Usd.TimeCode, *, files: bool = False) -> Sdf.Layer | None:
    """The strongest layer with a value for a time; with `files`, of those that are not in memory alone."""
    kinds = ("default",) if time.IsDefault() else ("default", "timeSamples")
    for spec in attribute.GetPropertyStack(time):
        if any(map(spec.HasInfo, kinds)) and not (files and spec.layer.anonymous):
            return spec.layer
    return None
