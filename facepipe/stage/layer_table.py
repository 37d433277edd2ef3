"""What the prims of one layer refer to, read without composing anything."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

from pxr import Ar, Sdf

from facepipe.core.errors import InputError
from facepipe.stage.layer_files import MOST_LEVELS, check_regular

_LISTS = {"references": False, "payload": False, "inheritPaths": True, "specializes": True}  # field: of classes
_FIELDS = frozenset((*_LISTS, "clips", "relocates"))
_MOST_CLIPS = 10_000  # files that a template of value clips stands for; USD looks for each


class Arc(NamedTuple):
    """A reference, payload, inherit or specialize."""

    asset: str  # empty: the same layers
    prim: Sdf.Path  # empty: the default prim
    offset: str  # arcs that differ in their times alone are two


class LayerTable:
    """The arcs of a layer by the prim that they stand on, those in variants included.

    :raises InputError: prims nested too deep or not there, or value clips of too many files or of no regular ones
    """

    def __init__(self, layer: Sdf.Layer) -> None:
        self.layer = layer
        self.arcs: dict[Sdf.Path, list[Arc]] = defaultdict(list)
        # classes and relocates: what other layers may add to, where they refer here
        self.has_classes = bool(layer.pseudoRoot.HasInfo("relocates"))
        self._prims: list[Sdf.Path] = []
        for prim in _prims(layer):
            path = prim.path.StripAllVariantSelections()
            self._prims.append(path)
            fields = prim.ListInfoKeys()
            if not _FIELDS.isdisjoint(fields):
                self._add(path, prim, fields)

    def _add(self, path: Sdf.Path, prim: Sdf.PrimSpec, fields: list[str]) -> None:
        for field, of_classes in _LISTS.items():
            if field in fields:
                self.arcs[path].extend(_arcs(prim.GetInfo(field)))
                self.has_classes |= of_classes
        self.has_classes |= "relocates" in fields
        if "clips" in fields:
            _check_clips(self.layer, prim)

    @cached_property
    def sizes(self) -> dict[Sdf.Path, int]:
        """Prims at and below each path."""
        sizes: dict[Sdf.Path, int] = defaultdict(int)
        for path in sorted(self._prims, key=_depth, reverse=True):
            sizes[path] += 1
        for path in sorted(sizes, key=_depth, reverse=True):
            sizes[path.GetParentPath()] += sizes[path]
        return sizes

    @cached_property
    def children_with_arcs(self) -> dict[Sdf.Path, set[Sdf.Path]]:
        """Children with arcs on them or below them."""
        children: dict[Sdf.Path, set[Sdf.Path]] = defaultdict(set)
        for path in self.arcs:
            child = path
            while child != Sdf.Path.absoluteRootPath:
                parent = child.GetParentPath()
                if child in children[parent]:
                    break
                children[parent].add(child)
                child = parent
        return children


def _depth(path: Sdf.Path) -> int:
    return int(path.pathElementCount)


def _prims(layer: Sdf.Layer) -> Iterator[Sdf.PrimSpec]:
    todo: list[Any] = list(layer.pseudoRoot.nameChildren.values())
    while todo:
        prim = todo.pop()
        if prim is None:
            raise InputError(layer.identifier, "is damaged: it lists a prim that it does not hold")
        if prim.path.pathElementCount > 2 * MOST_LEVELS:  # a prim in a variant has two
            raise InputError(layer.identifier, f"nests prims more than {MOST_LEVELS} deep")
        yield prim
        todo.extend(prim.nameChildren.values())
        for variants in prim.variantSets.values():
            found = variants.variants.values() if variants else (None,)
            todo.extend(one.primSpec if one else None for one in found)


def _arcs(edits: Any) -> Iterator[Arc]:
    for item in getattr(edits, "GetAddedOrExplicitItems", list)():
        if isinstance(item, Sdf.Path):
            yield Arc("", item, "")
        else:
            yield Arc(item.assetPath, item.primPath, repr(item.layerOffset))


def _check_clips(layer: Sdf.Layer, prim: Sdf.PrimSpec) -> None:
    """Value clips are files that USD opens when a value is read."""
    where = f"{layer.identifier} -> <{prim.path}>"
    for clips in prim.GetInfo("clips").values():
        names = [one.path for one in clips.get("assetPaths", ())]
        names += [clips["manifestAssetPath"].path] if "manifestAssetPath" in clips else []
        template = clips.get("templateAssetPath", "")
        if template:
            first, last, step = (float(clips.get(f"template{name}", 1)) for name in ("StartTime", "EndTime", "Stride"))
            if not step > 0 or not (last - first) / step <= _MOST_CLIPS:
                raise InputError(where, f"value clips of more than {_MOST_CLIPS} files")
            pattern = Path(layer.ComputeAbsolutePath(template))
            names += [str(path) for path in pattern.parent.glob(pattern.name.replace("#", "[0-9]"))]
        for name in names:
            check_regular(str(Ar.GetResolver().Resolve(layer.ComputeAbsolutePath(name))))
