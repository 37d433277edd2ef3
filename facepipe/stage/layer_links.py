"""What one USD file itself says: the layers that it names, and whether it holds a recipe of its own."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import facepipe_schemas
from pxr import Ar, Sdf

from facepipe.core import tokens
from facepipe.core.errors import InputError
from facepipe.stage.files import SUFFIXES, quiet_diagnostics
from facepipe.stage.guard import USD_ERRORS, reason
from facepipe.stage.layer_files import open_layer


class LayerLinks(NamedTuple):
    """Of one file, not of the layers below it."""

    layers: tuple[Path, ...]  # sublayers, references and payloads as files, there or lost
    has_recipe: bool


def layer_links(path: Path) -> LayerLinks:
    """The links of a USD file; what is open from it sees what the file holds now.

    :raises InputError: a damaged file, or one that is open with changes that are not saved
    """
    facepipe_schemas.register()
    with quiet_diagnostics():
        try:
            layer = _fresh(path)
            names = [Sdf.Layer.SplitIdentifier(one)[0] for one in layer.GetCompositionAssetDependencies()]
            found = tuple(dict.fromkeys(_file(layer, name) for name in names if not _packed(name)))
            return LayerLinks(found, _has_recipe(layer))
        except (*USD_ERRORS, RuntimeError) as error:
            raise InputError(path, f"can't be read as USD: {reason(error)}") from None


def _fresh(path: Path) -> Sdf.Layer:
    was_open = Sdf.Layer.Find(str(path)) is not None
    layer = open_layer(str(path))  # holds it; what Find gives can go while another thread closes its stage
    if layer is None:
        raise InputError(path, "can't be read as USD")
    if was_open and layer.dirty:
        raise InputError(path, "is open with changes that are not saved, expected them saved first")
    if was_open:
        layer.Reload()
    return layer


def _file(layer: Sdf.Layer, name: str) -> Path:
    return Path(layer.ComputeAbsolutePath(name))


def _packed(name: str) -> bool:
    """Whether it is inside a package, or of no kind that can hold a recipe."""
    return Ar.IsPackageRelativePath(name) or Path(name).suffix.lower() not in SUFFIXES


def _has_recipe(layer: Sdf.Layer) -> bool:
    prim = layer.GetPrimAtPath(f"/{layer.defaultPrim}") if layer.defaultPrim else None
    verb = prim.attributes.get(tokens.RECIPE_VERB) if prim else None
    return verb is not None and isinstance(verb.default, str) and bool(verb.default)
