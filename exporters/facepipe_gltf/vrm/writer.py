"""Writes a face as an avatar's head, one .vrm file."""

from __future__ import annotations

import os
import time
from dataclasses import asdict
from pathlib import Path

from facepipe.core.errors import InputError
from facepipe.core.reports import ExportReport
from facepipe.parts import HasParts
from facepipe.rig import set_face
from facepipe_gltf.files import embedded, write_glb
from facepipe_gltf.vrm.document import write_vrm
from facepipe_gltf.vrm.options import Options


def export(face: HasParts, path: str | os.PathLike[str], options: Options | None = None) -> ExportReport:
    """Write a face as VRM 1.0.

    :raises InputError: another suffix, no licence or authors, human bones that are missing, a shape glob that matches
        nothing, or no such pose
    :raises ExportError: a face that glTF can't hold
    """
    start = time.perf_counter()
    (target,) = outputs(path)
    options = options or Options()
    if options.pose == "set-joints":
        raise InputError("option pose", "set-joints scales joints, which VRM doesn't allow, expected set or rest")
    delivered = set_face(face.parts(), options.pose)
    written = write_vrm(delivered.parts, options, target.stem)
    document = written.document
    files = write_glb(target, *embedded(document))
    return ExportReport(
        path=target,
        files=tuple(files),
        counts=document.counts,
        bytes=target.stat().st_size,
        seconds=time.perf_counter() - start,
        warnings=document.warnings,
        dropped=document.dropped,
        added=written.added,
        error_mm=document.error_mm,
        pose=delivered.pose,
        pose_error=None if delivered.error is None else asdict(delivered.error),
    )


def outputs(path: str | os.PathLike[str]) -> tuple[Path, ...]:
    """The file that `export` to `path` writes.

    :raises InputError: another suffix than .vrm
    """
    target = Path(path)
    if target.suffix.lower() != ".vrm":
        raise InputError(target, f"suffix '{target.suffix}', expected .vrm")
    return (target,)
