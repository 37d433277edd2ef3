"""Stages saved as one file that needs no other stage: flattened, textures beside it or packed."""

from __future__ import annotations

import os
from pathlib import Path

from pxr import Usd, UsdUtils

from facepipe.core.atomic import together
from facepipe.stage.assets import asset_values, copy_refusal, name_of, read_image
from facepipe.stage.files import check_suffix, save_layer
from facepipe.stage.levels import flattened
from facepipe.stage.textures import TextureFolder, texture_home


def save_standalone(stage: Usd.Stage, path: str | os.PathLike[str]) -> None:
    """Flatten a stage and save it atomically; its textures are copied, so that the result can be moved.

    :raises InputError: a suffix that is not USD, a folder that can't be written, or a texture that may not be copied
    """
    target = Path(path)
    check_suffix(target)
    images = _images(stage)
    layer = flattened(stage)
    with texture_home(target) as home, together(target):
        folder = TextureFolder(home)
        copies = {resolved: folder.add(name_of(resolved), data) for resolved, data in images.items()}
        UsdUtils.ModifyAssetPaths(layer, lambda name: copies.get(name, name))
        folder.write()
        save_layer(layer, target, beside=home.parent)


def _images(stage: Usd.Stage) -> dict[str, bytes]:
    """The images that a stage names, by resolved path.

    :raises InputError: one that may not be copied
    """
    found: dict[str, bytes] = {}
    for attribute, time, asset in asset_values(stage):
        data = read_image(asset)
        if data is None:
            continue
        refusal = copy_refusal(attribute.GetPath(), attribute, asset, time)
        if refusal is not None:
            raise refusal
        found[asset.resolvedPath] = data
    return found
