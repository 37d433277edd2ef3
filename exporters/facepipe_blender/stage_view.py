"""Blender's prims on a stage: of which objects, with their places, UV names and materials."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdShade

from facepipe.core.arrays import FloatArray

_UV_TYPES = ("texCoord2f[]", "float2[]")
_OBJECT, _DATA = "blender:object_name", "blender:data_name"


class StageView:
    """A stage that Blender is about to save."""

    def __init__(self, stage: Usd.Stage) -> None:
        self.stage = stage
        self.unit = float(UsdGeom.GetStageMetersPerUnit(stage))
        self.up = "Z" if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z else "Y"
        self.folder = Path(stage.GetRootLayer().realPath).parent
        prims = list(stage.TraverseAll())
        self._objects = _by_name((prim for prim in prims if prim.IsA(UsdGeom.Xformable)), _OBJECT)
        self._materials = _by_name((prim for prim in prims if prim.IsA(UsdShade.Material)), _DATA)

    def prim(self, obj: Any) -> Usd.Prim | None:
        """The prim of an object; None where it was not exported."""
        return self._objects.get(str(obj.name)) or self._objects.get(_plain(obj.name))

    def matrix(self, obj: Any) -> FloatArray:
        """(4, 4) matrix from the space of an exported object to the world of the stage."""
        world = UsdGeom.Xformable(self.prim(obj)).ComputeLocalToWorldTransform(Usd.TimeCode.Default())
        return np.array(world, dtype=np.float64).T

    def uv_names(self, obj: Any) -> dict[str, str]:
        """The name on the stage of every exported UV map of a mesh object: one may be called `st` there."""
        meshes = [one for one in Usd.PrimRange(self.prim(obj)) if one.IsA(UsdGeom.Mesh)][:1]
        there = [
            str(primvar.GetPrimvarName())
            for mesh in meshes
            for primvar in UsdGeom.PrimvarsAPI(mesh).GetPrimvarsWithAuthoredValues()
            if str(primvar.GetTypeName()) in _UV_TYPES
        ]
        names = {layer.name: _plain(layer.name) for layer in obj.data.uv_layers if _plain(layer.name) in there}
        left = [layer.name for layer in obj.data.uv_layers if layer.name not in names]
        free = [name for name in there if name not in names.values()]
        return {**names, **dict(zip(left, free, strict=False))}

    def material(self, name: str) -> Sdf.Path | None:
        """The path of the prim of a material."""
        prim = self._materials.get(name) or self._materials.get(_plain(name))
        return None if prim is None else prim.GetPath()


def _by_name(prims: Any, label: str) -> dict[str, Usd.Prim]:
    """Prims by their names in Blender where it authored these, else by their own."""
    labelled: dict[str, Usd.Prim] = {}
    unlabelled: dict[str, Usd.Prim] = {}
    for prim in prims:
        names = [one for one in prim.GetAuthoredPropertyNames() if one == label or one.endswith(f":{label}")]
        if names:
            labelled.setdefault(str(prim.GetAttribute(names[0]).Get()), prim)
        else:
            unlabelled.setdefault(str(prim.GetName()), prim)
    return unlabelled | labelled


def _plain(name: str) -> str:
    """A name as Blender makes it an identifier."""
    text = re.sub(r"\W", "_", str(name))
    return f"_{text}" if text[:1].isdigit() else text
