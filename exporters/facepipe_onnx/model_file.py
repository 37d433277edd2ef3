"""A model and its sidecar as files."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from facepipe.core import __version__
from facepipe.core.atomic import together, write_bytes
from facepipe.core.errors import ExportError, InputError
from facepipe.onnx_graph import MAX_BYTES
from facepipe_onnx.metadata import sidecar_path, sidecar_text, to_properties
from facepipe_onnx.read import problems


def outputs(path: str | os.PathLike[str]) -> tuple[Path, Path]:
    """The files that `export` to `path` writes: the model and its sidecar.

    :raises InputError: another suffix than .onnx
    """
    target = Path(path)
    if target.suffix.lower() != ".onnx":
        raise InputError(target, f"suffix '{target.suffix}', expected .onnx")
    return target, sidecar_path(target)


def write_model(model: Any, metadata: dict[str, Any], name: str, path: str | os.PathLike[str]) -> int:
    """Write a model with its metadata, and that beside it, both or neither; the bytes of the model.

    :raises ExportError: more than a file holds, or anything that `problems` finds
    """
    target, beside = outputs(path)
    data = _serialised(model, metadata, name)
    with together(target):
        write_bytes(target, data)
        write_bytes(beside, sidecar_text(metadata).encode())
    return len(data)


def _serialised(model: Any, metadata: dict[str, Any], name: str) -> bytes:
    model.producer_version = __version__
    for key, value in to_properties(metadata).items():
        entry = model.metadata_props.add()
        entry.key, entry.value = key, value
    if model.ByteSize() > MAX_BYTES:
        raise ExportError(name, f"{model.ByteSize()} bytes, expected at most {MAX_BYTES}: what an ONNX file holds")
    for problem in problems(model):
        raise ExportError(f"{name} -> {problem.where}", problem.message)
    return bytes(model.SerializeToString(deterministic=True))
