"""Writes a face as .glb, or as .gltf with its buffer and images beside."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.core.errors import InputError
from facepipe.core.reports import ExportReport
from facepipe.parts import FaceParts, HasParts
from facepipe.rig import set_face
from facepipe_gltf.document import Document, write
from facepipe_gltf.files import embedded, separate, write_glb, write_gltf
from facepipe_gltf.options import Options

if TYPE_CHECKING:
    from facepipe_gltf.buffers import Chunk
    from facepipe_gltf.objects import Json, OnDocument


def export(
    face: HasParts,
    path: str | os.PathLike[str],
    options: Options | None = None,
    *,
    on_document: OnDocument | None = None,
) -> ExportReport:
    """Write a face as glTF 2.0, to .glb or .gltf by the suffix of `path`.

    :param on_document: gets the document as a `pygltflib.GLTF2`, to change it before it is saved
    :raises ExportError: a face that glTF can't hold: NaN or infinity, counts that don't fit, no skin weights; or
        `on_document` leaves a document that is damaged
    :raises InputError: another suffix, a folder that does not exist, a shape glob that matches nothing, no such pose,
        or no levels of detail where they are asked for
    """
    start = time.perf_counter()
    target = _target(path)
    options = options or Options()
    delivered = set_face(face.parts(), options.pose)
    levels: tuple[FaceParts, ...] = ()
    if options.lods:
        from facepipe_gltf.lods import lower_levels

        levels = lower_levels(face)
    document = write(delivered.parts, options, levels=[set_face(one, options.pose).parts for one in levels])
    files = save(document, target, on_document=on_document)
    return ExportReport(
        path=target,
        files=tuple(files),
        counts=document.counts,
        bytes=sum(file.stat().st_size for file in files),
        seconds=time.perf_counter() - start,
        warnings=document.warnings,
        dropped=document.dropped,
        error_mm=document.error_mm,
        pose=delivered.pose,
        pose_error=None if delivered.error is None else asdict(delivered.error),
    )


def outputs(path: str | os.PathLike[str]) -> tuple[Path, ...]:
    """The files that `export` to `path` writes whatever the face holds.

    :raises InputError: another suffix than .glb and .gltf
    """
    return (_target(path),)


def save(document: Document, path: str | os.PathLike[str], *, on_document: OnDocument | None = None) -> list[Path]:
    """Write a document; the paths of all files, the .glb or .gltf first.

    :param on_document: as of `export`
    :raises ExportError: `on_document` leaves a document that is damaged
    """
    target = _target(path)
    if target.suffix.lower() == ".glb":
        json, binary = embedded(document)
        return write_glb(target, _changed(json, on_document, target, binary), binary)
    json, sidecars = separate(document, target)
    return write_gltf(target, _changed(json, on_document, target, document.binary), sidecars)


def _changed(json: Json, on_document: OnDocument | None, target: Path, binary: Sequence[Chunk]) -> Json:
    if on_document is None:
        return json
    from facepipe_gltf.objects import changed

    return changed(json, on_document, target, b"".join(binary))


def _target(path: str | os.PathLike[str]) -> Path:
    target = Path(path)
    if target.suffix.lower() not in (".glb", ".gltf"):
        raise InputError(target, f"suffix '{target.suffix}', expected .glb or .gltf")
    return target
