"""The bytes of a face's arrays, counted before they are read: a file pays nothing for references and equal arrays."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from pxr import Sdf, Usd, UsdSkel

from facepipe.core.errors import InputError
from facepipe.core.policy.bounds import Budget, same_file
from facepipe.stage.assets import file_of
from facepipe.stage.guard import UNREADABLE

_FREE_BYTES, _PER_BYTE = 1 << 23, 8  # of the arrays of a face together: these, and as many for each byte of its layers
_KINDS_COUNTED = ("Mesh", "BlendShape", "SkelAnimation", "Skeleton", "GeomSubset", "SkelRoot")
_SCALAR_BYTES = {"bool": 1, "half": 2, "int": 4, "uint": 4, "float": 4, "string": 8, "token": 8, "quatf": 16}  # bytes
_DEFAULT = Usd.TimeCode.Default()


def check_arrays(prims: Sequence[Usd.Prim], where: object) -> None:
    """:raises InputError: arrays far beyond what the files of the stage hold; one that is made in memory has any"""
    stage = prims[0].GetStage() if prims else None
    layers = [] if stage is None else [layer for layer in stage.GetUsedLayers() if layer != stage.GetSessionLayer()]
    if any(layer.anonymous for layer in layers):
        return
    budget = Budget(_FREE_BYTES, _PER_BYTE)
    for layer in layers:
        file = file_of(layer.realPath)
        if file.is_file():
            budget.grant(os.stat(file).st_size, same_file(file))  # noqa: PTH116
    for prim in prims:
        if prim.GetTypeName() in _KINDS_COUNTED:
            for size in _sizes(prim):
                budget.spend(size, lambda what: InputError(where, what))


def _sizes(prim: Usd.Prim) -> Iterator[int]:
    """Bytes of each array of a prim; of an animation, all time samples, and else one, as no more is read."""
    for attribute in prim.GetAuthoredAttributes():
        if not attribute.GetTypeName().isArray:
            continue
        times = attribute.GetNumTimeSamples()
        try:
            value = attribute.Get(Usd.TimeCode.EarliestTime() if times else _DEFAULT)
        except UNREADABLE:
            continue  # its reader reports that
        yield (max(times, 1) if prim.IsA(UsdSkel.Animation) else 1) * _bytes(value, attribute.GetTypeName())


def _bytes(value: Any, kind: Sdf.ValueTypeName) -> int:
    if value is None or not hasattr(value, "__len__"):
        return 0
    return len(value) * _SCALAR_BYTES.get(str(kind.scalarType), np.asarray(kind.scalarType.defaultValue).nbytes)
