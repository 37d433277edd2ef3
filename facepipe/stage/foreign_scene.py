"""Which meshes of a foreign stage are the face's, what they need to be read, and the materials that they use."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdLux, UsdShade, UsdSkel

from facepipe.core import tokens
from facepipe.core.errors import InputError, SchemaError
from facepipe.core.images import damage_of
from facepipe.core.names import unknown
from facepipe.parts import Material
from facepipe.stage.composition import check_arrays
from facepipe.stage.files import open_stage
from facepipe.stage.foreign_motion import moving_of
from facepipe.stage.layer_files import name_of
from facepipe.stage.material_variants import Variants
from facepipe.stage.materials import USD_NAMES, Images, read_material
from facepipe.stage.materialx import read_materialx, unread_inputs
from facepipe.stage.prims import authored_skel_properties, check_kinds, distinct_names, is_applied, prims_below
from facepipe.stage.read_mesh import UV_TYPES
from facepipe.stage.values import ints, reads_prim

_CONTAINERS = ("", "Xform", "Scope", "SkelRoot")
_KNOWN_PROPERTIES = ("facepipe:", "skel:", "primvars:", "userProperties:blender:")  # the last repeat names
_PROPERTIES_LISTED = 3
_PER_POINT_OR_CORNER = ("vertex", "varying", "faceVarying")
_MTLX = re.compile(r"([^@/\\]{1,80}\.mtlx)[@:]")
_HIDDEN_PURPOSES = (UsdGeom.Tokens.guide, UsdGeom.Tokens.proxy)


class Scene:
    """Prims of a stage that may belong to a face."""

    def __init__(self, path: Path, root: str | None, variants: Mapping[str, str], *, strict: bool = False) -> None:
        """:raises InputError: no readable stage, no such root or variant, or more prims than a face can have"""
        self.path = path
        self.strict = strict  # textures that can't be read are errors
        # USD reads MaterialX files by a plug-in that its wheels lack: the rest of the stage is read without them
        self.stage = open_stage(path, lacking=(".mtlx",))
        self.stage.SetEditTarget(self.stage.GetSessionLayer())
        self.warnings: list[str] = []
        missing = sorted({one for error in self.stage.GetCompositionErrors() for one in _MTLX.findall(str(error))})
        if missing:
            self.warn(f"{', '.join(missing[:3])}: MaterialX files are not read, only materials authored as UsdShade")
        _choose_variants(self.stage, path, variants)
        self.roots = self._find_roots(root)
        # instances become plain prims: a repair below one is not one below all
        while instances := [prim for top in self.roots for prim in Usd.PrimRange(top) if prim.IsInstance()]:
            list(self._below())  # counts what they will become
            for prim in instances:
                prim.SetInstanceable(False)
        self.prims = list(self._below())
        check_kinds(self.prims, self.path)
        check_arrays(self.prims, self.path)
        above = [prim for top in self.roots for prim in ancestors(top)]
        self.warnings += _variants_in_effect([*above, *self.prims], variants)
        self.moving = moving_of(self.stage, self.prims, above, path)
        moving: dict[str, list[Usd.Prim]] = {}  # of what has only time samples the value of the first is kept
        for prim in [*self.prims, *above]:
            if prim.IsA(UsdSkel.Animation):
                continue
            for attribute in prim.GetAuthoredAttributes():
                samples = attribute.GetNumTimeSamples()
                # one sample alone counts at all times, whatever is authored without time
                if samples == 1 or (samples and attribute.Get() is None):
                    attribute.Set(attribute.Get(Usd.TimeCode.EarliestTime()))
                name = attribute.GetName()
                # transforms and points are motion, of which `foreign_motion` says what became
                kept = name.startswith("xformOp:") or (name == "points" and str(prim.GetPath()) in self.moving.points)
                if samples > 1 and not kept:
                    moving.setdefault(name, []).append(prim)
        for name, prims in sorted(moving.items()):
            self.warn(f"{name} change over time: one value is kept, of default or first time", dict.fromkeys(prims))
        # each root becomes a SkelRoot, and those below it plain Xforms: UsdSkel binds below the outermost alone
        for top in (top for top in self.roots if top.GetTypeName() in _CONTAINERS):
            for prim in Usd.PrimRange(top):
                if prim != top and prim.GetTypeName() == "SkelRoot":
                    prim.SetTypeName("Xform")
            top.SetTypeName("SkelRoot")
        # usdSkel reads skel properties only where their API is applied; files before 2021 have none
        lacking = [
            prim for prim in self.prims if not prim.HasAPI(UsdSkel.BindingAPI) and authored_skel_properties(prim)
        ]
        for prim in lacking:
            UsdSkel.BindingAPI.Apply(prim)
        if lacking:
            self.warn("SkelBindingAPI is not applied: skel properties are read all the same", lacking)

    def warn(self, what: str, culprits: Iterable[object] = ()) -> None:
        """Note something, with a few of the prims it is about."""
        listed = [f"<{culprit.GetPath()}>" if isinstance(culprit, Usd.Prim) else str(culprit) for culprit in culprits]
        more = f" and {len(listed) - 3} more" if len(listed) > 3 else ""
        self.warnings.append(f"{', '.join(listed[:3])}{more}: {what}" if listed else what)

    def error(self, what: str) -> InputError:
        """An error about the file."""
        return InputError(self.path, what)

    def _find_roots(self, root: str | None) -> list[Usd.Prim]:
        if root is not None:
            prim = self.stage.GetPrimAtPath(root) if root.startswith("/") and root != "/" else None
            if not prim:
                raise self.error(f"no prim at root '{root}', expected the path of one")
            return [prim]
        default = self.stage.GetDefaultPrim()
        if default and any(prim.IsA(UsdGeom.Mesh) for prim in prims_below(default, self.path)):
            return [default]
        top = [prim for prim in self.stage.GetPseudoRoot().GetChildren() if prim.IsActive() and prim.IsDefined()]
        if default:
            self.warn("the default prim has no meshes: the whole stage is read", [default])
        return top

    def _below(self) -> Iterator[Usd.Prim]:
        for root in self.roots:
            yield from prims_below(root, self.path)


def ancestors(prim: Usd.Prim) -> Iterator[Usd.Prim]:
    """The prims above a prim, the nearest first."""
    prim = prim.GetParent()
    while prim and not prim.IsPseudoRoot():
        yield prim
        prim = prim.GetParent()


def _choose_variants(stage: Usd.Stage, path: Path, chosen: Mapping[str, str]) -> None:
    """Select in the edit target what is `chosen`, variant by set, on every prim that has such a set.

    :raises InputError: no prim has such a set, or none that has it such a variant
    """
    sets: dict[str, None] = {}
    offered: dict[str, list[str]] = {name: [] for name in chosen}
    selected: set[tuple[str, str]] = set()
    while True:  # a variant may bring further sets
        fresh = 0
        for prim in stage.TraverseAll():
            for name in prim.GetVariantSets().GetNames():
                variants = prim.GetVariantSets().GetVariantSet(name)
                sets[name] = None
                key = (str(prim.GetPath()), name)
                if name not in chosen or key in selected:
                    continue
                offered[name] += variants.GetVariantNames()
                if chosen[name] in variants.GetVariantNames():
                    selected.add(key)
                    fresh += variants.SetVariantSelection(chosen[name])
        if not fresh:
            break
    for name, variant in chosen.items():
        if name not in sets:
            raise InputError(path, unknown(name, sets, "variant set"))
        if variant not in offered[name]:
            known = list(dict.fromkeys(offered[name]))
            raise InputError(f"{path} -> variant set {name}", unknown(variant, known, "variant"))


def _variants_in_effect(prims: Iterable[Usd.Prim], chosen: Mapping[str, str]) -> list[str]:
    """One line for every set that was not chosen and offers more than what was read."""
    sets: dict[tuple[str, str, tuple[str, ...]], list[str]] = {}
    for prim in prims:
        for name in prim.GetVariantSets().GetNames():
            variants = prim.GetVariantSets().GetVariantSet(name)
            names, current = variants.GetVariantNames(), variants.GetVariantSelection()
            whole = name == tokens.VARIANTS and is_applied(prim, tokens.FACE_API)  # read with all of them
            if name not in chosen and names != [current] and not whole:
                sets.setdefault((name, current, tuple(names)), []).append(f"<{prim.GetPath()}>")
    return [
        f"{owners[0]}{f' and {len(owners) - 1} more' if len(owners) > 1 else ''}: variant {current or 'none'} of the "
        f"set {name} is read, of {', '.join(names)} (--variant {name}=NAME chooses)"
        for (name, current, names), owners in sets.items()
    ]


def choose_meshes(scene: Scene) -> list[Usd.Prim]:
    """Meshes that are shown and have faces; what else is drawn is named in warnings."""
    found = [prim for prim in scene.prims if prim.IsA(UsdGeom.Mesh)]
    hidden = [prim for prim in found if UsdGeom.Imageable(prim).ComputeVisibility() == UsdGeom.Tokens.invisible]
    helpers = [prim for prim in found if UsdGeom.Imageable(prim).ComputePurpose() in _HIDDEN_PURPOSES]
    unseen = {*hidden, *helpers}
    shown = [prim for prim in found if prim not in unseen]
    empty = [prim for prim in shown if not _has_faces(prim)]
    for prims, what in ((hidden, "invisible"), (helpers, "of purpose guide or proxy"), (empty, "without faces")):
        if prims:
            scene.warn(f"mesh {what}: left out", prims)
    lights = (UsdLux.BoundableLightBase, UsdLux.NonboundableLightBase)
    drawn = (UsdGeom.Gprim, UsdGeom.PointInstancer, UsdGeom.Camera, *lights)
    others = [prim for prim in scene.prims if any(prim.IsA(kind) for kind in drawn) and not prim.IsA(UsdGeom.Mesh)]
    for kind, count in sorted(Counter(str(prim.GetTypeName()) for prim in others).items()):
        scene.warn(f"{count} of type {kind}: left out", [prim for prim in others if prim.GetTypeName() == kind])
    without = set(empty)
    return [prim for prim in shown if prim not in without]


@reads_prim
def _has_faces(prim: Usd.Prim) -> bool:
    mesh = UsdGeom.Mesh(prim)
    return bool(mesh.GetPointsAttr().Get()) and bool(mesh.GetFaceVertexIndicesAttr().Get())


def note_custom(scene: Scene) -> None:
    """Properties and data of a prim that no schema knows are named in a warning."""
    unknown: dict[str, list[Usd.Prim]] = {}
    for prim in scene.prims:
        properties = [prop.GetName() for prop in prim.GetAuthoredProperties() if prop.IsCustom()]
        data = [key for key in prim.GetCustomData() if prim.HasAuthoredCustomDataKey(key) and key != "Blender"]
        for name in [*properties, *(f"customData {key}" for key in data)]:
            if not name.startswith(_KNOWN_PROPERTIES):
                unknown.setdefault(name, []).append(prim)
    for name, prims in sorted(unknown.items())[:_PROPERTIES_LISTED]:
        scene.warn(f"{name}, which no schema knows: left out", prims)
    if len(unknown) > _PROPERTIES_LISTED:
        scene.warn(f"{len(unknown) - _PROPERTIES_LISTED} more kinds of properties that no schema knows: left out")


def mend_meshes(scene: Scene, meshes: list[Usd.Prim]) -> None:
    """Blocks what our parts can't hold, and names it."""
    dropped: dict[str, list[Usd.Prim]] = {}
    for prim in meshes:
        for mend in _mend(prim):
            dropped.setdefault(mend, []).append(prim)
    for mend, prims in sorted(dropped.items()):
        scene.warn(mend, prims)


@reads_prim
def _mend(prim: Usd.Prim) -> list[str]:
    mesh, notes = UsdGeom.Mesh(prim), []
    for primvar in UsdGeom.PrimvarsAPI(prim).GetPrimvarsWithAuthoredValues():
        name = str(primvar.GetPrimvarName())
        if name.startswith(("skel:", tokens.REGION_PRIMVAR)) or name == "normals":
            continue
        problem = _primvar_problem(mesh, primvar, is_color=name == "displayColor")
        if problem:
            primvar.GetAttr().Block()
            notes.append(f"primvar {name} {problem}: left out")
    # normals of other than point or face-vertex interpolation: the reader knows these by their count
    primvar = UsdGeom.PrimvarsAPI(prim).GetPrimvar("normals")
    given = [(mesh.GetNormalsAttr(), mesh.GetNormalsInterpolation())]
    if primvar and primvar.HasAuthoredValue():
        given.append((primvar.GetAttr(), primvar.GetInterpolation()))
    for attribute, interpolation in given:
        if attribute.HasAuthoredValue() and interpolation not in _PER_POINT_OR_CORNER:
            attribute.Block()
            notes.append(f"normals of {interpolation} interpolation: left out")
    scheme = mesh.GetSubdivisionSchemeAttr().Get()
    if scheme != UsdGeom.Tokens.none:
        notes.append(f"subdivision surface ({scheme}): kept as its base cage")
        if mesh.GetCreaseIndicesAttr().Get() or mesh.GetCornerIndicesAttr().Get():
            notes.append("creases and corners: left out")
    if mesh.GetHoleIndicesAttr().Get():
        notes.append("holes: their faces are kept")
    return notes


def _primvar_problem(mesh: UsdGeom.Mesh, primvar: UsdGeom.Primvar, *, is_color: bool) -> str | None:
    """Why a primvar is no UV set, and no colour that fits where it may be one; None where it is."""
    interpolation = str(primvar.GetInterpolation())
    points = len(mesh.GetPointsAttr().Get())
    if is_color:  # for all points or one each; per face or corner it would need points of its own
        count = len(primvar.ComputeFlattened() or ())
        if count == 1 or (interpolation in ("vertex", "varying") and count == points):
            return None
    if str(primvar.GetTypeName()) not in UV_TYPES:
        return f"of type {primvar.GetTypeName()}"
    if interpolation not in _PER_POINT_OR_CORNER:
        return f"of {interpolation} interpolation"
    values = primvar.Get()
    indices = ints(primvar.GetIndices()) if primvar.IsIndexed() else None
    count = len(values if indices is None else indices)
    expected = len(mesh.GetFaceVertexIndicesAttr().Get()) if interpolation == "faceVarying" else points
    if count != expected:
        return f"with {count} values, expected {expected}"
    if indices is not None and indices.size and not (indices.min() >= 0 and indices.max() < len(values)):
        return f"with indices outside 0..{len(values) - 1}"
    return None if np.isfinite(np.array(values)).all() else "with NaN or infinity"


def bindings(scene: Scene) -> dict[str, UsdSkel.SkinningQuery]:
    """The skinning query of every bound mesh by its path."""
    queries: dict[str, UsdSkel.SkinningQuery] = {}
    for root in scene.roots:
        if not root.IsA(UsdSkel.Root):
            continue
        cache = UsdSkel.Cache()
        cache.Populate(UsdSkel.Root(root), Usd.PrimDefaultPredicate)
        for binding in cache.ComputeSkelBindings(UsdSkel.Root(root), Usd.PrimDefaultPredicate):
            queries |= {str(query.GetPrim().GetPath()): query for query in binding.GetSkinningTargets()}
    return queries


def bound_materials(
    scene: Scene, meshes: list[Usd.Prim], variants: Variants
) -> tuple[dict[str, str], tuple[Material, ...]]:
    """Names by prim path, and the materials, of those bound to meshes or their faces that are UsdPreviewSurface, by
    variants too."""
    bound: dict[str, Usd.Prim] = {}
    for mesh in meshes:
        subsets = UsdGeom.Subset.GetAllGeomSubsets(UsdGeom.Imageable(mesh))
        for prim in [mesh, *(subset.GetPrim() for subset in subsets)]:
            material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
            if material:
                bound[str(material.GetPath())] = material.GetPrim()
    for path in (path for at_variant in variants.others.values() for path in at_variant.values() if path):
        bound.setdefault(str(path), scene.stage.GetPrimAtPath(path))
    names = dict(
        zip(bound, distinct_names([*bound.values()], [str(prim.GetName()) for prim in bound.values()]), strict=True)
    )
    images: Images = {}
    read = {path: _read(scene, prim, names[path], images) for path, prim in bound.items()}
    names = {path: names[path] for path, material in read.items() if material is not None}
    try:
        shown = variants.of_materials(str(scene.path), names)
    except SchemaError as error:
        scene.warn(f"{error}: variants of materials left out")
        shown = {}
    kept = (replace(one, variants=shown.get(one.name, {})) for one in read.values() if one is not None)
    return names, tuple(kept)


def _read(scene: Scene, prim: Usd.Prim, name: str, images: Images) -> Material | None:
    """One material; a texture that can't be had is left out of it."""
    known = {*images}
    while True:
        try:
            material = read_material(prim, name, images) or read_materialx(prim, name, images)
            # why an image of the material may not be copied
            inputs = material.textured.values() if material else ()
            if refusal := next((used.texture.refusal for used in inputs if used.texture.refusal), None):
                raise refusal
            new = {path: data for path, data in images.items() if data and path not in known}
            damaged = {path: damage for path, data in new.items() if (damage := damage_of(data))}
            if not damaged:
                break
            for path, damage in damaged.items():
                scene.warn(f"{name_of(path)} {damage}")
                images[path] = None
        except InputError as error:
            attribute = scene.stage.GetAttributeAtPath(Sdf.Path(error.where))
            if scene.strict or not attribute or not attribute.HasAuthoredValue():
                raise
            scene.warn(f"{error}: left out")
            # and read again, as several textures of a material may be missing, and each read names the first
            attribute.Block()
    if material is None:
        scene.warn("material without UsdPreviewSurface or a surface of MaterialX: left out", [prim])
        return None
    surface, _, _ = UsdShade.Material(prim).ComputeSurfaceSource()
    if surface and surface.GetShaderId() == "UsdPreviewSurface":
        named = {*USD_NAMES.values(), "useSpecularWorkflow"}  # the latter apart
        lost = sorted({shader_input.GetBaseName() for shader_input in surface.GetInputs()} - named)
        if surface.GetInput("useSpecularWorkflow") and surface.GetInput("useSpecularWorkflow").Get():
            lost.append("the specular workflow")
    else:
        lost = unread_inputs(prim)
    if lost:
        scene.warn(f"{', '.join(lost)} of the material: left out", [prim])
    return material
