"""The part of a foreign stage that is read, its variants, and its session layer, where repairs go."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from pxr import Usd, UsdGeom, UsdSkel

from facepipe.core.errors import InputError
from facepipe.core.names import unknown
from facepipe.stage.array_counts import check_arrays
from facepipe.stage.bindings import authored_skel_properties
from facepipe.stage.files import open_stage
from facepipe.stage.prims import check_kinds, prims_below

_CONTAINERS = ("", "Xform", "Scope", "SkelRoot")


class Scene:
    """Prims of a stage that may belong to a face."""

    def __init__(self, path: Path, root: str | None, variants: Mapping[str, str]) -> None:
        """:raises InputError: no readable stage, no such root or variant, or more prims than a face can have"""
        self.path = path
        self.stage = open_stage(path)
        self.stage.SetEditTarget(self.stage.GetSessionLayer())
        self.warnings: list[str] = []
        _choose_variants(self.stage, path, variants)
        self.roots = self._find_roots(root)
        self._open_instances()
        self.prims = list(self._below())
        check_kinds(self.prims, self.path)
        check_arrays(self.prims, self.path)
        above = [prim for top in self.roots for prim in ancestors(top)]
        self.warnings += _variants_in_effect([*above, *self.prims], variants)
        self._default_values()
        self._skel_roots()
        self._binding_api()

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

    def _open_instances(self) -> None:
        """Instances become plain prims: a repair below one is not one below all."""
        while True:
            instances = [prim for root in self.roots for prim in Usd.PrimRange(root) if prim.IsInstance()]
            if not instances:
                return
            list(self._below())  # counts what they will become
            for prim in instances:
                prim.SetInstanceable(False)

    def _default_values(self) -> None:
        """Values of the first time sample where there are only time samples."""
        moving: dict[str, list[Usd.Prim]] = {}
        above = [ancestor for root in self.roots for ancestor in ancestors(root)]
        for prim in [*self.prims, *above]:
            if prim.IsA(UsdSkel.Animation):
                continue
            for attribute in prim.GetAuthoredAttributes():
                samples = attribute.GetNumTimeSamples()
                if samples and attribute.Get() is None:
                    attribute.Set(attribute.Get(Usd.TimeCode.EarliestTime()))
                if samples > 1:
                    name = attribute.GetName()
                    moving.setdefault("transforms" if name.startswith("xformOp:") else name, []).append(prim)
        for name, prims in sorted(moving.items()):
            self.warn(f"{name} change over time: one value is kept, of default or first time", dict.fromkeys(prims))

    def _skel_roots(self) -> None:
        """Each root becomes a SkelRoot, and those below it plain Xforms: UsdSkel binds below the outermost alone."""
        for root in self.roots:
            if root.GetTypeName() not in _CONTAINERS:
                continue
            for prim in Usd.PrimRange(root):
                if prim != root and prim.GetTypeName() == "SkelRoot":
                    prim.SetTypeName("Xform")
            root.SetTypeName("SkelRoot")

    def _binding_api(self) -> None:
        """UsdSkel reads skel properties only where their API is applied; files before 2021 have none."""
        lacking = [
            prim for prim in self.prims if not prim.HasAPI(UsdSkel.BindingAPI) and authored_skel_properties(prim)
        ]
        for prim in lacking:
            UsdSkel.BindingAPI.Apply(prim)
        if lacking:
            self.warn("SkelBindingAPI is not applied: skel properties are read all the same", lacking)


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
            if name not in chosen and names != [current]:
                sets.setdefault((name, current, tuple(names)), []).append(f"<{prim.GetPath()}>")
    return [
        f"{owners[0]}{f' and {len(owners) - 1} more' if len(owners) > 1 else ''}: variant {current or 'none'} of the "
        f"set {name} is read, of {', '.join(names)} (--variant {name}=NAME chooses)"
        for (name, current, names), owners in sets.items()
    ]
