"""Regions authored on meshes: soft masks as primvars, and point subsets of hard ones."""

from __future__ import annotations

import numpy as np
from pxr import Sdf, Usd, UsdGeom

from facepipe.core import tokens
from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.parts import Mesh
from facepipe.stage.api_schemas import apply_schema, check_property_name, instances, remove_schema
from facepipe.stage.values import floats, ints, to_floats, to_ints

SUBSET_FAMILY = "facepipeRegion"


def check_region_name(where: object, name: str) -> None:
    """:raises InputError: a name that USD can't hold, or one of the region schema itself"""
    check_property_name(where, "region", name, tokens.REGION_API)


def author_regions(prim: Usd.Prim, mesh: Mesh) -> None:
    """Write the regions of `mesh` on a Mesh prim; those that it has and `mesh` lacks are blocked.

    Masks that are on the prim already are left alone, so that a layer holds only what changed.

    :raises InputError: a name that USD can't hold, or a prim inside an instance
    """
    for name in mesh.regions:
        check_region_name(prim.GetPath(), name)
    _check_writable(prim)
    api = UsdGeom.PrimvarsAPI(prim)
    for name, mask in mesh.regions.items():
        if name not in instances(prim, tokens.REGION_API):
            apply_schema(prim, tokens.REGION_API, name)
        primvar = api.GetPrimvar(tokens.REGION_PRIMVAR + name)
        if not _holds(primvar, mask):
            kind = Sdf.ValueTypeNames.FloatArray
            primvar = api.CreatePrimvar(tokens.REGION_PRIMVAR + name, kind, UsdGeom.Tokens.vertex)
            primvar.Set(to_floats(mask))
            if primvar.IsIndexed():
                primvar.BlockIndices()
    for primvar in api.GetPrimvarsWithAuthoredValues():
        name = str(primvar.GetPrimvarName())
        if name.startswith(tokens.REGION_PRIMVAR) and name.removeprefix(tokens.REGION_PRIMVAR) not in mesh.regions:
            primvar.GetAttr().Block()  # BlockPrimvar blocks nothing that a weaker layer holds
    for name in instances(prim, tokens.REGION_API):
        if name not in mesh.regions:
            remove_schema(prim, tokens.REGION_API, name)


def author_region_subsets(prim: Usd.Prim, subsets: dict[str, IntArray], removed: tuple[str, ...]) -> None:
    """Write point subsets by name on a Mesh prim, and deactivate those called as in `removed`.

    Subsets that hold the points already are left alone.

    :raises InputError: a prim inside an instance, or a child that is no subset in the way
    """
    _check_writable(prim)
    for name, indices in subsets.items():
        child = prim.GetChild(name)
        if child and not child.IsA(UsdGeom.Subset):
            raise InputError(child.GetPath(), f"is a {child.GetTypeName()}, expected a GeomSubset for the region")
        if child and not child.IsActive():
            child.SetActive(True)
        old = UsdGeom.Subset(child).GetIndicesAttr().Get() if child else None
        if old is None or not np.array_equal(ints(old), indices):
            UsdGeom.Subset.CreateGeomSubset(
                UsdGeom.Imageable(prim), name, UsdGeom.Tokens.point, to_ints(indices), SUBSET_FAMILY
            )
    for name in removed:
        child = prim.GetChild(name)
        if child and child.IsA(UsdGeom.Subset):
            child.SetActive(False)


def _holds(primvar: UsdGeom.Primvar, mask: FloatArray) -> bool:
    if not primvar or not primvar.HasAuthoredValue() or primvar.IsIndexed():
        return False
    plain = primvar.GetTypeName() == Sdf.ValueTypeNames.FloatArray
    vertex = primvar.GetInterpolation() == UsdGeom.Tokens.vertex
    return plain and vertex and np.array_equal(floats(primvar.Get()), np.asarray(mask, dtype=np.float32))


def _check_writable(prim: Usd.Prim) -> None:
    if prim.IsInstanceProxy():
        raise InputError(prim.GetPath(), "lies in an instance, expected a mesh of its own to write regions on")
