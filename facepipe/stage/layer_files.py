"""Layer files, looked at before USD opens or composes them: their nesting and the counts that they promise are bounded,
and what their prims refer to is listed.
"""

from __future__ import annotations

import mmap
import re
import struct
from collections import defaultdict
from collections.abc import Iterator
from functools import cached_property
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pxr import Ar, Sdf

from facepipe.core.errors import InputError
from facepipe.core.policy.paths import check_readable

MOST_LEVELS = 200  # USD recurses into nested prims, layers and arcs
_MOST_COUNTED = 1 << 20  # of the paths, specs, ... of a binary layer, beyond its bytes

# Text is cut down to what quotes and nests; arrays would take seconds. Bytes 1, 2 and 3 stand for long quotes in it.
_LONG_QUOTES = ((b'"""', b"\x01"), (b"'''", b"\x02"), (b"@@@", b"\x03"))
_NO_QUOTES = (b"\x01", b"\x02", b"\x03", b"\\\\", b'\\"', b"\\'")
_MARKS = b"\n\"'@<>#/*[{}`"
_WORDS = re.compile(
    rb"\x01[^\x01]*\x01?|\x02[^\x02]*\x02?|\x03[^\x03]*\x03?|\"[^\"\n]*\"|'[^'\n]*'|@[^@\n]*@|<[^>\n]*>"
    rb"|/\*(?s:.*?)(?:\*/|\Z)|//[^\n]*|#[^\n]*|[{}]"
)
_DEEP_PATH = re.compile(rb"<[^<>\n]{%d}" % (2 * MOST_LEVELS))  # of what is left of it: / [ {
_LISTS = {"references": False, "payload": False, "inheritPaths": True, "specializes": True}  # field: of classes
_FIELDS = frozenset((*_LISTS, "clips", "relocates"))
_MOST_CLIPS = 10_000  # files that a template of value clips stands for; USD looks for each


def open_layer(identifier: str) -> Sdf.Layer | None:
    """The layer of an identifier; None where it leads nowhere.

    :raises InputError: no regular file, outside the roots of confined reads, or one that promises too much
    :raises USD_ERRORS, RuntimeError, OSError: a damaged or unreadable file
    """
    name = str(Ar.GetResolver().Resolve(Sdf.Layer.SplitIdentifier(identifier)[0]))
    if not name:
        return None
    file, inner = check_regular(name), Ar.SplitPackageRelativePathOuter(name)[1]
    if not file.stat().st_size:  # which can't be mapped
        return Sdf.Layer.FindOrOpen(identifier)
    with file.open("rb") as opened, mmap.mmap(opened.fileno(), 0, access=mmap.ACCESS_READ) as data:
        if not inner and file.suffix.lower() == ".usdz":
            # USD takes the first file in a package for its layer
            if data[:4] == b"PK\3\4" and len(data) >= 30:
                (length,) = struct.unpack_from("<H", data, 26)
                inner = data[30 : 30 + length].decode(errors="replace")
            name = Ar.JoinPackageRelativePath([str(file), inner])
        if not inner:
            check_content(name, data)
    if inner.lower().endswith((".usdz", "]")):
        raise InputError(name, "is a package in a package, expected a layer")
    if inner:
        asset = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(name))
        check_content(name, bytes(asset.GetBuffer()) if asset else b"")
    return Sdf.Layer.FindOrOpen(identifier)


def check_regular(name: str) -> Path:
    """The file, which may be a package, of a resolved name.

    :raises InputError: a folder, pipe or device, or outside the roots of confined reads
    """
    file = Path(Ar.SplitPackageRelativePathOuter(name)[0])
    check_readable(file)
    if file.exists() and not file.is_file():
        raise InputError(file, "is no regular file, expected a USD file")
    return file


def check_content(where: object, data: bytes | mmap.mmap) -> None:
    """:raises InputError: nested too deep for USD's reader, or counts that the bytes can't hold"""
    if data[:8] == b"PXR-USDC":
        _check_counts(where, data)
    elif data[:1] == b"#":
        _check_text(where, data)


def _check_text(where: object, data: bytes | mmap.mmap) -> None:
    text = data[:]
    marks = text.translate(None, _all_but(_MARKS))
    expressions = b"`" in marks or b"pathExpression" in text
    if not expressions and marks.count(b"{") <= 2 * MOST_LEVELS and not _DEEP_PATH.search(marks):
        return
    kept = _MARKS + b"\x01\x02\x03" + (b"()" if expressions else b"")
    # one blank for each run of other bytes: what stood apart still does
    other = _all_but(kept + b"\\")
    blanked = np.frombuffer(text.translate(bytes.maketrans(other, b" " * len(other))), np.uint8)
    needed = blanked != 32
    needed[1:] |= needed[:-1].copy()
    text = bytes(blanked[needed])
    for old, new in (*((quote, b"") for quote in _NO_QUOTES), *_LONG_QUOTES):
        text = text.replace(old, new)
    depth = 0
    for match in _WORDS.finditer(text.translate(None, _all_but(kept))):
        word = match[0]
        depth += (word == b"{") - (word == b"}")
        levels = len(word) if word[:1] == b"<" else 0  # at most, of a path
        if not levels and word.count(b"(") > MOST_LEVELS:  # of an expression in quotes
            levels = max(accumulate((byte == 0x28) - (byte == 0x29) for byte in word))
        if max(depth, levels) > 2 * MOST_LEVELS:  # a prim in a variant has two
            raise InputError(where, f"can't be read as USD: nests more than {2 * MOST_LEVELS} deep")


def _all_but(kept: bytes) -> bytes:
    return bytes(set(range(256)) - set(kept))


def _check_counts(where: object, data: bytes | mmap.mmap) -> None:
    """Check the sections of a binary layer, each of which begins with the number of what it holds.

    :raises InputError: a number that the bytes can't hold
    """
    if len(data) < 24:
        return
    (contents,) = struct.unpack_from("<q", data, 16)
    if not 24 <= contents <= len(data) - 8:
        return  # USD says what is wrong with it
    (sections,) = struct.unpack_from("<Q", data, contents)
    for number in range(min(sections, 64)):
        at = contents + 8 + 32 * number
        if at + 32 > len(data):
            return
        start = struct.unpack_from("<16sqq", data, at)[1]
        if not 24 <= start <= len(data) - 8:
            continue
        (count,) = struct.unpack_from("<Q", data, start)
        if count > _MOST_COUNTED + len(data):
            raise InputError(where, f"can't be read as USD: promises {count} entries in {len(data)} bytes")


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
            if _FIELDS.isdisjoint(fields):
                continue
            for field in (field for field in _LISTS if field in fields):
                self.has_classes |= _LISTS[field]
                arcs = self.arcs[path]
                for item in getattr(prim.GetInfo(field), "GetAddedOrExplicitItems", list)():
                    is_path = isinstance(item, Sdf.Path)
                    arc = Arc("", item, "") if is_path else Arc(item.assetPath, item.primPath, repr(item.layerOffset))
                    arcs.append(arc)
            self.has_classes |= "relocates" in fields
            if "clips" in fields:
                _check_clips(layer, prim)

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


def _check_clips(layer: Sdf.Layer, prim: Sdf.PrimSpec) -> None:
    """Value clips are files that USD opens when a value is read."""
    where = f"{layer.identifier} -> <{prim.path}>"
    for clips in prim.GetInfo("clips").values():
        names = [asset.path for asset in clips.get("assetPaths", ())]
        names += [clips["manifestAssetPath"].path] if "manifestAssetPath" in clips else []
        template = clips.get("templateAssetPath", "")
        if template:
            first, last, step = (float(clips.get(f"template{name}", 1)) for name in ("StartTime", "EndTime", "Stride"))
            if not step > 0 or not (last - first) / step <= _MOST_CLIPS:
                raise InputError(where, f"value clips of more than {_MOST_CLIPS} files")
            pattern = Path(layer.ComputeAbsolutePath(template))
            check_readable(pattern.parent)
            names += [str(path) for path in pattern.parent.glob(pattern.name.replace("#", "[0-9]"))]
        for name in names:
            check_regular(str(Ar.GetResolver().Resolve(layer.ComputeAbsolutePath(name))))


def file_of(path: str) -> Path:
    """The file that a resolved path is in: the outer package, where it is packed."""
    return Path(Ar.SplitPackageRelativePathOuter(path)[0])


def name_of(path: str) -> str:
    """The file name of a resolved path, that in the package, where it is packed."""
    return Path(Ar.SplitPackageRelativePathInner(path)[1] or path).name
