"""A stage as one layer, with what its face has in variants: levels of detail, and materials."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pxr import Sdf, Usd

from facepipe.core import tokens
from facepipe.stage.files import at_variants, level_names, lower_levels
from facepipe.stage.material_variants import BINDING, put_binding, put_variant_name, variant_names, variant_place
from facepipe.stage.values import usd_errors


def flattened(stage: Usd.Stage) -> Sdf.Layer:
    """All that a stage shows in one layer, with the variants of its face's materials, and with the other levels of it
    where it shows the finest.

    :raises InputError: what USD can't write
    """
    layer, prim = stage.Flatten(), stage.GetDefaultPrim()
    if not prim:
        return layer
    with usd_errors(f"{Path(stage.GetRootLayer().realPath or 'stage').name} -> <{prim.GetPath()}>"):
        levels = _keep_levels(stage, layer, prim)
        # `Sdf.CopySpec` copies fields in the order that their names have in memory, which is that in which threads
        # first met them, and crate files keep it; text has them in one order, so that every run writes the same bytes
        if _keep_variants(prim, layer, levels) or levels:
            ordered = Sdf.Layer.CreateAnonymous(".usda")
            ordered.ImportFromString(layer.ExportToString())
            return ordered
    return layer


def _keep_levels(stage: Usd.Stage, layer: Sdf.Layer, prim: Usd.Prim) -> list[Sdf.Path]:
    """Write the other levels of a face that shows its finest into a layer flattened from its stage; their places."""
    names = level_names(prim)
    if not names or prim.GetVariantSet(tokens.LEVELS).GetVariantSelection() != names[0]:
        return []
    spec, places = layer.GetPrimAtPath(prim.GetPath()), []
    spec.variantSetNameList.prependedItems = [tokens.LEVELS]
    levels_of = Sdf.VariantSetSpec(spec, tokens.LEVELS)
    Sdf.VariantSpec(levels_of, names[0])
    # `Flatten` keeps the selected variant alone: of the others what they turn off and what they add is written anew
    for name, level in zip(names[1:], lower_levels(stage), strict=True):
        place, flat = Sdf.VariantSpec(levels_of, name).primSpec, level.Flatten()
        places.append(place.path)
        for full in Usd.PrimRange(prim):
            same = level.GetPrimAtPath(full.GetPath())
            if same and not same.IsActive():
                below = full.GetPath().MakeRelativePath(prim.GetPath())
                Sdf.CreatePrimInLayer(layer, place.path.AppendPath(below)).active = False
        for child in level.GetPrimAtPath(prim.GetPath()).GetChildren():
            known = prim.GetChild(child.GetName())
            if not (known and known.IsDefined()):
                Sdf.CopySpec(flat, child.GetPath(), layer, place.path.AppendChild(child.GetName()))
    spec.variantSelections[tokens.LEVELS] = names[0]
    return places


def _keep_variants(face: Usd.Prim, layer: Sdf.Layer, levels: Sequence[Sdf.Path]) -> bool:
    """Give a layer that was flattened from the face's stage the variants of its materials; whether it has any.

    :param levels: places in the layer of what other levels of the face say
    """
    names, found, calls = variant_names(face), [], []
    if not names:
        return False
    for stage in at_variants(face.GetStage(), face.GetPath(), tokens.VARIANTS, names):
        at = stage.GetPrimAtPath(face.GetPath())
        calls.append(at.GetAttribute(tokens.VARIANT_NAME).Get())
        found.append(
            {
                (prim.GetPath().MakeRelativePath(face.GetPath()), str(one.GetName())): tuple(one.GetTargets())
                for prim in Usd.PrimRange.AllPrims(at)
                for one in prim.GetAuthoredRelationships()
                if one.GetName().startswith(BINDING)
            }
        )
    every = dict.fromkeys(key for one in found for key in one)
    changed = [key for key in every if len({one.get(key) for one in found}) > 1]
    if not changed:
        return False
    # what is beside the variants would win over them
    for below, name in changed:
        for root in (face.GetPath(), *levels):
            spec = layer.GetPrimAtPath(root.AppendPath(below))
            if spec and name in spec.relationships:
                spec.RemoveProperty(spec.relationships[name])
                # what was flattened of a mesh of another level is now an over of nothing
                while spec.specifier == Sdf.SpecifierOver and spec.isInert:
                    inert, spec = spec.name, spec.nameParent
                    del spec.nameChildren[inert]
    spec = layer.GetPrimAtPath(face.GetPath())
    if tokens.VARIANT_NAME in spec.attributes:
        spec.RemoveProperty(spec.attributes[tokens.VARIANT_NAME])
    for variant, bound, call in zip(names, found, calls, strict=True):
        place = variant_place(layer, face.GetPath(), variant)
        for key in changed:
            if key in bound:
                put_binding(layer, place, *key, bound[key])
        if call:
            put_variant_name(place, call)
    if current := face.GetVariantSet(tokens.VARIANTS).GetVariantSelection():
        spec.variantSelections[tokens.VARIANTS] = current
    return True
