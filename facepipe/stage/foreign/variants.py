"""Variants of a foreign stage: which are read."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from pxr import Usd

from facepipe.core.errors import InputError
from facepipe.core.names import unknown


def choose_variants(stage: Usd.Stage, path: Path, chosen: Mapping[str, str]) -> None:
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


def variants_in_effect(prims: Iterable[Usd.Prim], chosen: Mapping[str, str]) -> list[str]:
    """One line for every set that was not chosen and offers more than what was read."""
    found: dict[tuple[str, str, tuple[str, ...]], list[str]] = {}
    for prim in prims:
        for name in prim.GetVariantSets().GetNames():
            variants = prim.GetVariantSets().GetVariantSet(name)
            names, current = variants.GetVariantNames(), variants.GetVariantSelection()
            if name not in chosen and names != [current]:
                found.setdefault((name, current, tuple(names)), []).append(f"<{prim.GetPath()}>")
    return [
        f"{owners[0]}{f' and {len(owners) - 1} more' if len(owners) > 1 else ''}: variant {current or 'none'} of the "
        f"set {name} is read, of {', '.join(names)} (--variant {name}=NAME chooses)"
        for (name, current, names), owners in found.items()
    ]
