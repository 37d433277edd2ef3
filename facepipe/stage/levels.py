"""Levels of detail on a stage: variants of the face prim, each with meshes of its own.

The first variant is the face itself and holds nothing. Any other turns the meshes of the layers below off and brings
others in their place: a variant can't be stronger than what these layers say of a mesh, and nothing that they say later
can spoil another mesh. All else of the face is shared.
"""

from __future__ import annotations

from collections.abc import Iterator

from pxr import Sdf, Usd

from facepipe.core import tokens
from facepipe.stage.files import with_ordered_fields


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
    # `Flatten` keeps the selected variant alone: of the others what they turn off and what they add is written anew
    for name, level in zip(names[1:], lower_levels(stage), strict=True):
        place, flat = Sdf.VariantSpec(levels_of, name).primSpec, level.Flatten()
        for full in Usd.PrimRange(prim):
            same = level.GetPrimAtPath(full.GetPath())
            if same and not same.IsActive():
                below = full.GetPath().MakeRelativePath(prim.GetPath())
                Sdf.CreatePrimInLayer(layer, place.path.AppendPath(below)).active = False
        for child in level.GetPrimAtPath(prim.GetPath()).GetChildren():
            if not prim.GetChild(child.GetName()):
                Sdf.CopySpec(flat, child.GetPath(), layer, place.path.AppendChild(child.GetName()))
    spec.variantSelections[tokens.LEVELS] = names[0]
    return with_ordered_fields(layer)
