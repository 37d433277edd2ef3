"""What a file is for: which shapes, meshes, materials and pictures of a face go into it, and how small."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from facepipe.parts import FaceParts
from facepipe.rig.conventions import meaning
from facepipe_gltf.options import PURPOSES, Options


class Purposed(NamedTuple):
    """A face, and the options to write it with."""

    parts: FaceParts
    levels: tuple[FaceParts, ...]
    options: Options
    chosen: tuple[str, ...]  # one line each


def purposed(name: str, parts: FaceParts, levels: Sequence[FaceParts], options: Options) -> Purposed:
    """What a purpose by name makes of a face and its lower levels; all that is given beside it stays as given.

    :raises InputError: pictures that may not be copied
    """
    purpose, engine, lines = PURPOSES[name], options.reader, list[str]()
    if purpose.animations and not options.animations:
        options = replace(options, animations=True)
        lines.append("--animations")
    if purpose.expressions and options.shapes == "*" and not options.customisable:
        kept = [shape for shape in parts.shapes if meaning(shape) is not None]
        if kept:
            options = replace(options, shapes=",".join(kept))
            lines.append(f"{len(kept)} of {len(parts.shapes)} shapes, of expressions (--customisable keeps all)")
        elif parts.shapes:
            lines.append(f"all {len(parts.shapes)} shapes: none has a name of ARKit's or another table's")
    every = (parts, *levels)
    if purpose.merged:
        from facepipe_gltf.merging import merged

        whole = tuple(merged(one) for one in every)
        meshes, materials = (
            (len(getattr(parts, kind)), len(getattr(whole[0], kind))) for kind in ("meshes", "materials")
        )
        lines.append(f"{meshes[0]} meshes and {materials[0]} materials as {meshes[1]} and {materials[1]}")
        every = whole
    kind = options.texture_format or purpose.pictures
    if kind == "webp" and not engine.webp and options.texture_format is None:
        kind = "jpeg"
        lines.append(f"pictures as JPEG: {engine.title} reads no WebP")
    if kind is not None and kind != "kept":
        size = options.texture_size or purpose.size or None
        options = replace(options, texture_format=kind, texture_size=size)
        lines.append(f"--texture-format {kind}{f' --texture-size {size}' if size else ''}")
    if options.quantize is None and purpose.small and engine.quantized:
        options = replace(options, quantize=True)
        lines.append("--quantize")
    if options.meshopt is None and purpose.small and engine.meshopt:
        from facepipe_gltf.document import meshopt_missing

        missing = meshopt_missing()
        if missing is None:
            options = replace(options, meshopt=True)
        lines.append("--meshopt" if missing is None else f"without --meshopt, which {missing}")
    return Purposed(parts=every[0], levels=every[1:], options=options, chosen=tuple(lines))
