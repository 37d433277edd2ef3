"""Skel properties that hold for a prim: its own, or those of the nearest prim above (UsdSkel binding rules)."""

from __future__ import annotations

from pxr import Sdf, Usd

SKEL_PROPERTIES = (
    "primvars:skel:jointIndices",
    "primvars:skel:jointWeights",
    "primvars:skel:geomBindTransform",
    "skel:skeleton",
    "skel:animationSource",
    "skel:joints",
    "skel:blendShapes",
    "skel:blendShapeTargets",
)


def authored_skel_properties(prim: Usd.Prim) -> list[str]:
    """The skel properties that a prim has itself."""
    return [name for name in SKEL_PROPERTIES if prim.GetProperty(name) and prim.GetProperty(name).IsAuthored()]


def inherited_attribute(prim: Usd.Prim, name: str) -> Usd.Attribute | None:
    """An attribute with a value, of the prim or the nearest one above that has it."""
    while prim and not prim.IsPseudoRoot():
        attribute = prim.GetAttribute(name)
        if attribute and attribute.HasAuthoredValue():
            return attribute
        prim = prim.GetParent()
    return None


def inherited_skeleton(prim: Usd.Prim) -> Sdf.Path | None:
    """What skel:skeleton of the prim or the nearest one above names, whether it is there or not."""
    while prim and not prim.IsPseudoRoot():
        relationship = prim.GetRelationship("skel:skeleton")
        named = relationship.GetForwardedTargets() if relationship else []
        if named:
            return named[0]
        prim = prim.GetParent()
    return None
