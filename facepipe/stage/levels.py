"""Levels of detail on a stage: variants of the face prim, each with meshes of its own.

The first variant is the face itself and holds nothing. Any other turns the meshes of the layers below off and brings
others in their place: a variant can't be stronger than what these layers say of a mesh, and nothing that they say later
can spoil another mesh. All else of the face is shared.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdShade, UsdSkel

from facepipe.core import tokens
from facepipe.core.names import unique_identifiers
from facepipe.parts import Mesh
from facepipe.stage.author_mesh import author_mesh
from facepipe.stage.files import with_ordered_fields
from facepipe.stage.prims import editable, prims_below
from facepipe.stage.values import matrix

if TYPE_CHECKING:
    from facepipe.stage.face import Face


def author_levels(face: Face, levels: Sequence[Sequence[Mesh]]) -> None:
    """Author the lower levels of a face over an override layer, which stays at the finest level.

    :param levels: of each level, and of each mesh of the face, what takes its place
    """
    meshes = [face.mesh_prim(mesh.name).GetPath() for mesh in face.meshes]
    for path in meshes:
        editable(face.stage.GetPrimAtPath(path))
    levels_of = face.prim.GetVariantSets().AddVariantSet(tokens.LEVELS)
    names = [f"{tokens.LEVELS}{number}" for number in range(len(levels) + 1)]
    for name in names:
        levels_of.AddVariant(name)
    for name, level in zip(names[1:], levels, strict=True):
        levels_of.SetVariantSelection(name)
        with levels_of.GetVariantEditContext():
            for path in meshes:
                face.stage.GetPrimAtPath(path).SetActive(False)
            prims = list(prims_below(face.prim, face.where))
            (skeleton,) = (UsdSkel.Skeleton(prim) for prim in prims if prim.IsA(UsdSkel.Skeleton))
            materials = {
                label: UsdShade.Material(face.stage.GetPrimAtPath(path)) for path, label in face.material_names.items()
            }
            taken = [str(child.GetName()) for child in face.prim.GetAllChildren()]
            children = unique_identifiers([*taken, *(f"{mesh.name}_{name}" for mesh in level)])[len(taken) :]
            to_face = np.linalg.inv(
                matrix(UsdGeom.Xformable(face.prim).ComputeLocalToWorldTransform(Usd.TimeCode.Default()))
            )
            for mesh, child in zip(level, children, strict=True):
                here = replace(mesh, transform=to_face @ mesh.transform)
                author_mesh(
                    face.stage, face.prim.GetPath().AppendChild(child), here, skeleton, face.skeleton.joints, materials
                )
    levels_of.SetVariantSelection(names[0])


def level_names(prim: Usd.Prim) -> tuple[str, ...]:
    """The levels of a face, finest first; none for most faces."""
    return tuple(prim.GetVariantSet(tokens.LEVELS).GetVariantNames())


def lower_levels(stage: Usd.Stage) -> Iterator[Usd.Stage]:
    """A stage at each lower level of the face that is its default prim, good or damaged."""
    prim = stage.GetDefaultPrim()
    for name in level_names(prim)[1:] if prim else ():
        yield stage_at(stage, prim.GetPath(), name)


def stage_at(stage: Usd.Stage, path: Sdf.Path, name: str) -> Usd.Stage:
    """Another stage of the same layers, with the face prim at a level."""
    session = Sdf.Layer.CreateAnonymous(".usda")
    at_level = Usd.Stage.Open(stage.GetRootLayer(), session)
    with Usd.EditContext(at_level, session):
        at_level.GetPrimAtPath(path).GetVariantSet(tokens.LEVELS).SetVariantSelection(name)
    return at_level


def flattened(stage: Usd.Stage) -> Sdf.Layer:
    """All that a stage shows in one layer, with the other levels of its face where it shows the finest."""
    layer, prim = stage.Flatten(), stage.GetDefaultPrim()
    names = level_names(prim) if prim else ()
    if not names or prim.GetVariantSet(tokens.LEVELS).GetVariantSelection() != names[0]:
        return layer
    spec = layer.GetPrimAtPath(prim.GetPath())
    spec.variantSetNameList.prependedItems = [tokens.LEVELS]
    levels_of = Sdf.VariantSetSpec(spec, tokens.LEVELS)
    Sdf.VariantSpec(levels_of, names[0])
    for name, level in zip(names[1:], lower_levels(stage), strict=True):
        _put_level(level, prim, Sdf.VariantSpec(levels_of, name).primSpec)
    spec.variantSelections[tokens.LEVELS] = names[0]
    return with_ordered_fields(layer)


def _put_level(level: Usd.Stage, full: Usd.Prim, place: Sdf.PrimSpec) -> None:
    """Write what a level turns off and what it adds, into a variant."""
    layer, flat = place.layer, level.Flatten()
    for prim in Usd.PrimRange(full):
        same = level.GetPrimAtPath(prim.GetPath())
        if same and not same.IsActive():
            below = prim.GetPath().MakeRelativePath(full.GetPath())
            Sdf.CreatePrimInLayer(layer, place.path.AppendPath(below)).active = False
    for child in level.GetPrimAtPath(full.GetPath()).GetChildren():
        if not full.GetChild(child.GetName()):
            Sdf.CopySpec(flat, child.GetPath(), layer, place.path.AppendChild(child.GetName()))
