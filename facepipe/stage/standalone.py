"""Stages saved as one file that needs no other stage: flattened, textures beside it or packed."""

from __future__ import annotations

import os
from pathlib import Path

from pxr import Ar, Usd, UsdUtils

from facepipe.stage.files import check_suffix, save_layer
from facepipe.stage.textures import TextureFolder, is_image, texture_home


def save_standalone(stage: Usd.Stage, path: str | os.PathLike[str]) -> None:
    """Flatten a stage and save it atomically; its textures are copied, so that the result can be moved.

    :raises InputError: a suffix that is not USD, or a folder that can't be written
    """
    target = Path(path)
    check_suffix(target)
    layer = stage.Flatten()
    with texture_home(target) as home:
        folder = TextureFolder(home)
        UsdUtils.ModifyAssetPaths(layer, lambda name: _copied(name, folder))
        folder.write()
        save_layer(layer, target, beside=home.parent)


def _copied(name: str, folder: TextureFolder) -> str:
    """The path of a copy of the image that `name` resolves to; `name` itself where it is none."""
    resolver = Ar.GetResolver()
    resolved = resolver.Resolve(name)
    asset = resolver.OpenAsset(resolved) if resolved else None
    data = bytes(asset.GetBuffer()) if asset else b""
    if not is_image(data):
        return name
    outer = str(resolved)
    inner = Ar.SplitPackageRelativePathInner(outer)[1] if Ar.IsPackageRelativePath(outer) else outer
    return folder.add(Path(inner).name, data)
