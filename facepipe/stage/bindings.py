"""Skel properties that hold for a prim: its own, or those of the nearest prim above (UsdSkel binding rules)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

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
    authored = set(prim.GetAuthoredPropertyNames())
    return [name for name in SKEL_PROPERTIES if name in authored]


Known = dict[str, dict[Sdf.Path, Any]]  # property -> prim -> what was found to hold there


def inherited_attribute(prim: Usd.Prim, name: str, known: Known | None = None) -> Usd.Attribute | None:
    """An attribute with a value, of the prim or the nearest one above that has it.

    :param known: what was found before on a stage that has not changed since; filled in
    """

    def attribute_on(prim: Usd.Prim) -> Usd.Attribute | None:
        attribute = prim.GetAttribute(name)
        return attribute if attribute and attribute.HasAuthoredValue() else None

    return _nearest(prim, attribute_on, {} if known is None else known.setdefault(name, {}))


def inherited_skeleton(prim: Usd.Prim, known: Known | None = None) -> Sdf.Path | None:
    """What skel:skeleton of the prim or the nearest one above names, whether it is there or not; `known` as above."""

    def skeleton_on(prim: Usd.Prim) -> Sdf.Path | None:
        relationship = prim.GetRelationship("skel:skeleton")
        named = relationship.GetForwardedTargets() if relationship else []
        return named[0] if named else None

    return _nearest(prim, skeleton_on, {} if known is None else known.setdefault("skel:skeleton", {}))


def _nearest(prim: Usd.Prim, value_on: Callable[[Usd.Prim], Any], known: dict[Sdf.Path, Any]) -> Any:
    above, nearest = [], None
    while nearest is None and prim and not prim.IsPseudoRoot():
        path = prim.GetPath()
        if path in known:
            nearest = known[path]
            break
        above.append(path)
        nearest = value_on(prim)
        prim = prim.GetParent()
    known.update(dict.fromkeys(above, nearest))
    return nearest
