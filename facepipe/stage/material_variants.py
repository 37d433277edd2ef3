"""Variants of a face's materials: the variant set ``shadingVariant`` of its prim.

What a mesh or some of its faces show is bound within the variants alone where it changes with them: what stands beside
a variant wins over it. ``default`` has the materials that meshes name; each other variant binds all of the same prims,
so that none shows what an earlier selection did. The bindings stand at the face also for meshes of its other levels,
which another variant set brings: where these are not shown they are overs of nothing.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from pxr import Sdf, Usd, UsdGeom, UsdShade

from facepipe.core import tokens
from facepipe.core.errors import InputError, SchemaError
from facepipe.core.names import handles, identifier, numbered
from facepipe.stage.files import at_variants
from facepipe.stage.prims import prims_below

MOST_VARIANTS = 256  # each is a composition of the face to read
MOST_BINDINGS = 1 << 15  # of meshes and parts of meshes in all variants: so many are read in a second
BINDING = "material:binding"
_PLAIN = re.compile(r"[A-Za-z0-9_|-]{1,200}")  # what USD calls variants beside identifiers


def variant_identifiers(names: Iterable[str]) -> tuple[str, ...]:
    """What USD is to call variants, in order: their names where it can, else identifiers that are free."""
    plain = (name if _PLAIN.fullmatch(name) else identifier(name) for name in names)
    return numbered(plain, [tokens.DEFAULT_VARIANT])


class Bindings:
    """Binds prims to materials; those whose material has variants together, once all else is authored."""

    def __init__(
        self, where: object, prims: Mapping[str, UsdShade.Material], variants: Mapping[str, Mapping[str, str]]
    ) -> None:
        """
        :param prims: materials by name
        :param variants: of materials that have some, by name
        :raises InputError: a variant that shows no material of the face
        """
        self._prims = prims
        self._variants = {material: shown for material, shown in variants.items() if shown}
        self._bound: dict[Sdf.Path, str] = {}
        for material, shown in self._variants.items():
            for variant, other in shown.items():
                if other not in prims:
                    what = f"no material '{other}', which its variant {variant} shows"
                    raise InputError(f"{where} -> {material}", what)

    def bind(self, prim: Usd.Prim, material: str) -> None:
        """Bind a mesh, or some of its faces.

        :raises InputError: no such material
        """
        if material not in self._prims:
            raise InputError(prim.GetPath(), f"no material '{material}'")
        api = UsdShade.MaterialBindingAPI.Apply(prim)
        if material in self._variants:
            self._bound[prim.GetPath()] = material
        else:
            api.Bind(self._prims[material])

    def author(self, face: Usd.Prim, identifiers: Mapping[str | None, str] | None = None) -> None:
        """Write what was bound to materials with variants into each variant of the face.

        :param identifiers: of variants that the face has already; None is what it shows now
        """
        if not self._bound:
            return
        names = list(dict.fromkeys(name for shown in self._variants.values() for name in shown))
        layer = face.GetStage().GetEditTarget().GetLayer()
        of_names = variant_identifiers(names)
        known: dict[str | None, str] = {None: tokens.DEFAULT_VARIANT}
        known |= zip(names, of_names, strict=True)
        with Sdf.ChangeBlock():  # the stage composes what is new once
            for name, own in (known if identifiers is None else identifiers).items():
                place = variant_place(layer, face.GetPath(), own)
                for path, material in self._bound.items():
                    shown = material if name is None else self._variants[material].get(name, material)
                    below = path.MakeRelativePath(face.GetPath())
                    put_binding(layer, place, below, BINDING, [self._prims[shown].GetPath()])
                if identifiers is None and name not in (None, own):
                    put_variant_name(place, str(name))
            if identifiers is None:
                layer.GetPrimAtPath(face.GetPath()).variantSelections[tokens.VARIANTS] = tokens.DEFAULT_VARIANT


def variant_names(face: Usd.Prim) -> list[str]:
    """What USD calls the variants of a face's materials; none for most faces."""
    sets = face.GetVariantSets()
    names = sets.GetVariantSet(tokens.VARIANTS).GetVariantNames() if sets.HasVariantSet(tokens.VARIANTS) else []
    return [name for name in names if name]  # one without a name is none: USD takes it for no selection


def check_variants(where: object, variants: int, bindings: int) -> None:
    """Check how many variants there are beside ``default``, and meshes and parts of meshes in each.

    :raises InputError: more than a face can have
    """
    if variants > MOST_VARIANTS:
        raise InputError(where, f"{variants} variants of materials, expected at most {MOST_VARIANTS}")
    if variants * bindings > MOST_BINDINGS:
        what = f"{variants} variants of materials of {bindings} meshes and parts of meshes"
        raise InputError(where, f"{what}, expected at most {MOST_BINDINGS // bindings} variants of so many")


def variant_place(layer: Sdf.Layer, face: Sdf.Path, name: str) -> Sdf.PrimSpec:
    """The place of what a variant says, made where it is not there."""
    spec = Sdf.CreatePrimInLayer(layer, face)
    if tokens.VARIANTS not in spec.variantSets:
        Sdf.VariantSetSpec(spec, tokens.VARIANTS)
        spec.variantSetNameList.Prepend(tokens.VARIANTS)
    variants = spec.variantSets[tokens.VARIANTS]
    found = variants.variants.get(name)
    return (Sdf.VariantSpec(variants, name) if found is None else found).primSpec


def put_binding(layer: Sdf.Layer, place: Sdf.PrimSpec, below: Sdf.Path, name: str, targets: Sequence[Sdf.Path]) -> None:
    itself = below == Sdf.Path.reflexiveRelativePath
    prim = place if itself else Sdf.CreatePrimInLayer(layer, place.path.AppendPath(below))
    relationship = prim.relationships.get(name) or Sdf.RelationshipSpec(prim, name, False)
    relationship.targetPathList.explicitItems = list(targets)


def put_variant_name(place: Sdf.PrimSpec, name: str) -> None:
    attribute = Sdf.AttributeSpec(
        place, tokens.VARIANT_NAME, Sdf.ValueTypeNames.String, Sdf.VariabilityUniform, declaresCustom=False
    )
    attribute.default = name


@dataclass(frozen=True)
class Variants:
    """The variants of a face on its stage, and what they bind where that differs from what it shows now."""

    identifiers: Mapping[str | None, str] = field(default_factory=dict)  # by exact name; None: what it shows now
    shown: Mapping[Sdf.Path, Sdf.Path] = field(default_factory=dict)  # mesh or faces -> material that it shows now
    others: Mapping[str, Mapping[Sdf.Path, Sdf.Path]] = field(default_factory=dict)  # by variant, of the same prims

    def of_materials(self, where: str, names: Mapping[str, str]) -> dict[str, dict[str, str]]:
        """Material -> variant -> material shown in its place, for materials that change.

        :param names: by prim path
        :raises SchemaError: what is no material of the face, or a material that changes otherwise on other faces
        """
        found: dict[str, tuple[Sdf.Path, dict[str, str]]] = {}
        for path, material in self.shown.items():
            of_variants = {variant: bound[path] for variant, bound in self.others.items()}
            if {*of_variants.values()} == {material}:
                of_variants = {}  # not in the set, or as if it weren't
            for variant, other in of_variants.items():
                if not {str(material), str(other)} <= names.keys():
                    now, then = (f"<{one}>" if one else "no material" for one in (material, other))
                    what = f"shows {now}, and {then} in the variant {variant}, expected materials of the face"
                    raise SchemaError(f"{where} -> <{path}>", what)
            if str(material) not in names:
                continue
            row = {variant: names[str(other)] for variant, other in of_variants.items()}
            first, same = found.setdefault(names[str(material)], (path, row))
            if same != row:
                raise SchemaError(
                    f"{where} -> <{path}>",
                    f"its material {names[str(material)]} changes with variants otherwise than on <{first}>, expected "
                    "a material of its own",
                )
        return {material: row for material, (_, row) in found.items() if row}


def read_variants(face: Usd.Prim, where: str) -> Variants:
    """The variants of a face's materials.

    :raises SchemaError: more than a face can have
    """
    names, current = variant_names(face), face.GetVariantSet(tokens.VARIANTS).GetVariantSelection()
    if not names:
        return Variants()
    paths = [prim.GetPath() for prim in _bindable(face, where)]
    try:
        check_variants(where, len(names) - (tokens.DEFAULT_VARIANT in names), len(paths))
    except InputError as error:
        raise SchemaError(error.where, error.what) from None
    shown = _bound(face.GetStage(), paths)
    calls, bound = {}, {}
    for own, at in zip(names, at_variants(face.GetStage(), face.GetPath(), tokens.VARIANTS, names), strict=True):
        call = str(at.GetPrimAtPath(face.GetPath()).GetAttribute(tokens.VARIANT_NAME).Get() or "")
        if own == current == tokens.DEFAULT_VARIANT and not call:
            continue  # what the face shows without variants is none of its variants
        calls[own] = call or own
        bound[own] = _bound(at, paths)
    exact = handles([*calls.values()], "variant")
    identifiers: dict[str | None, str] = {None: current} if current else {}
    identifiers |= zip(exact, calls, strict=True)
    return Variants(identifiers, shown, dict(zip(exact, bound.values(), strict=True)))


def _bindable(face: Usd.Prim, where: str) -> Iterable[Usd.Prim]:
    """The meshes of a face, and the parts of their faces."""
    for prim in prims_below(face, where):
        if prim.IsA(UsdGeom.Mesh):
            yield prim
            for subset in UsdGeom.Subset.GetAllGeomSubsets(UsdGeom.Imageable(prim)):
                if subset.GetElementTypeAttr().Get() == UsdGeom.Tokens.face:
                    yield subset.GetPrim()


def _bound(stage: Usd.Stage, paths: Sequence[Sdf.Path]) -> dict[Sdf.Path, Sdf.Path]:
    """What prims are bound to; an empty path for nothing."""
    prims = [stage.GetPrimAtPath(path) for path in paths]
    there = [prim for prim in prims if prim]
    materials = UsdShade.MaterialBindingAPI.ComputeBoundMaterials(there)[0] if there else []
    found = {prim.GetPath(): material.GetPath() for prim, material in zip(there, materials, strict=True) if material}
    return {path: found.get(path, Sdf.Path()) for path in paths}
