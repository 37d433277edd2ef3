"""Opinions of an override layer: where they may stand, and what they hide of weaker layers."""

from __future__ import annotations

from pxr import Sdf, Usd, UsdGeom

from facepipe.core.names import unique_identifiers


def editable(prim: Usd.Prim, *, below: bool = False) -> Usd.Prim:
    """The prim at the same path where opinions count: instances that it stands in are no longer instanced.

    :param below: for opinions on prims below it too
    """
    stage, path = prim.GetStage(), prim.GetPath()
    while prim.IsInstanceProxy() or (below and prim.IsInstance()):
        instance = prim
        while instance.IsInstanceProxy() or not instance.IsInstance():
            instance = instance.GetParent()
        instance.SetInstanceable(False)
        prim = stage.GetPrimAtPath(path)
    return prim


def free_path(face: Usd.Prim, folder: str, name: str) -> Sdf.Path:
    """A path in a scope of a face for what is called as its prim: that of a deactivated prim where there is one."""
    path = face.GetPath().AppendChild(folder)
    scope = face.GetStage().GetPrimAtPath(path) or UsdGeom.Scope.Define(face.GetStage(), path).GetPrim()
    children = {str(child.GetName()): child for child in editable(scope, below=True).GetAllChildren()}
    if name in children and not children[name].IsActive():
        children.pop(name).SetActive(True)
    return path.AppendChild(unique_identifiers([*children, name])[-1])
