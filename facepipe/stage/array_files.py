"""The file beside a .usda that holds its big arrays: numbers are no text that anyone reads or compares.

Of the head in the box 42 MB of text were 40 MB of numbers, which USD took 2 s to parse. They stand in
``<stem>_arrays.usdc``, which is the first sublayer of the text: opinions there are as strong as its own, so that no
reader, layer above or variant sees a difference.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from pxr import Sdf, Usd

from facepipe.core import tokens
from facepipe.core.errors import InputError
from facepipe.core.reading import is_file
from facepipe.stage.layer_files import open_layer
from facepipe.stage.values import USD_ERRORS

_MOST_IN_TEXT = 1 << 20  # bytes of arrays that a .usda holds itself; below, one file is worth more than short text
_BIG = 1024  # bytes of an array that goes out
_SHARED = ("timeCodesPerSecond", "framesPerSecond")  # of both layers, lest USD scales times from one to the other


def arrays_file(stage_file: Path) -> Path:
    """Where the big arrays of a .usda that is written go."""
    return stage_file.parent / f"{stage_file.stem}_arrays.usdc"


def is_arrays_file(name: str, stage_file: Path) -> bool:
    """Whether a sublayer of a stage file, as it is named there, holds its arrays."""
    return name == f"./{arrays_file(stage_file).name}"


def check_arrays_file(stage_file: Path) -> None:
    """Check that a .usda may be written with arrays beside it.

    :raises InputError: another file is in the place of these
    """
    place = arrays_file(stage_file)
    if not is_file(place):
        return
    try:
        layer = open_layer(str(place))
    except (*USD_ERRORS, RuntimeError, OSError):
        layer = None
    if layer is None or layer.customLayerData.get(tokens.ARRAYS_OF) != stage_file.name:
        raise InputError(place, f"does not hold the arrays of {stage_file.name}, which go there; expected another name")


def check_arrays_there(stage: Usd.Stage) -> None:
    """:raises InputError: a layer of the stage was moved or sent without its arrays"""
    for layer in stage.GetLayerStack(includeSessionLayers=False):
        file = Path(layer.realPath)
        if layer.realPath and not is_file(arrays_file(file)):
            for name in filter(lambda name: is_arrays_file(name, file), layer.subLayerPaths):
                raise InputError(file, f"no {name} beside it, where its arrays are; expected both files together")


def split_arrays(layer: Sdf.Layer, target: Path) -> tuple[Sdf.Layer, Sdf.Layer | None]:
    """The layer as text, and its big arrays as another below it; the layer itself, and None, where these are few."""
    found: dict[Sdf.Path, int] = {}
    prims: list[Sdf.Path] = []

    def look(path: Sdf.Path) -> None:
        if (path.IsPrimPath() or path.IsPrimVariantSelectionPath()) and layer.GetPrimAtPath(path):
            prims.append(path)
        spec = layer.GetAttributeAtPath(path) if path.IsPropertyPath() else None
        if spec is not None and spec.typeName.isArray:
            each = [spec.default, *(spec.GetInfo("timeSamples") or {}).values()]
            found[path] = sum(_bytes(value) for value in each)

    layer.Traverse(Sdf.Path.absoluteRootPath, look)
    if sum(found.values()) <= _MOST_IN_TEXT:
        return layer, None
    text, arrays = Sdf.Layer.CreateAnonymous(".usda"), Sdf.Layer.CreateAnonymous(".usdc")
    text.TransferContent(layer)
    text.subLayerPaths.insert(0, f"./{arrays_file(target).name}")
    arrays.customLayerData = {tokens.ARRAYS_OF: target.name}
    for key in _SHARED:
        if layer.pseudoRoot.HasInfo(key):
            arrays.pseudoRoot.SetInfo(key, layer.pseudoRoot.GetInfo(key))
    with Sdf.ChangeBlock():
        # all of them: USD lists the children of a prim as its weakest layer does, and then those that others add
        for path in prims:
            Sdf.CreatePrimInLayer(arrays, path)
        for path in (path for path, size in found.items() if size >= _BIG):
            _move(text.GetAttributeAtPath(path), arrays)
    return text, arrays


def _bytes(value: Any) -> int:
    return 0 if value is None or not hasattr(value, "__len__") else np.asarray(value).nbytes


def _move(spec: Sdf.AttributeSpec, arrays: Sdf.Layer) -> None:
    """What an attribute is stays where it was; its values go to `arrays`."""
    owner = arrays.GetPrimAtPath(spec.path.GetParentPath())
    moved = Sdf.AttributeSpec(owner, spec.name, spec.typeName, spec.variability, declaresCustom=spec.custom)
    if spec.HasDefaultValue():
        moved.default = spec.default
        spec.ClearDefaultValue()
    if spec.HasInfo("timeSamples"):
        for code, value in spec.GetInfo("timeSamples").items():
            arrays.SetTimeSample(moved.path, code, value)
        spec.ClearInfo("timeSamples")
