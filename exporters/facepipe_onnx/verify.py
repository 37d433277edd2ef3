"""Named checks of an exported graph, for `facepipe validate`."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from facepipe.core.errors import InputError
from facepipe.core.reading import read_bytes
from facepipe.core.reports import Finding
from facepipe.onnx_graph import MAX_BYTES
from facepipe_onnx import sidecar
from facepipe_onnx.metadata_checks import properties
from facepipe_onnx.read import Problem, problems, read


def validate(path: str | os.PathLike[str]) -> tuple[Finding, ...]:
    """What is wrong with a .onnx deformer and its sidecar.

    :raises InputError: no such file, or no ONNX at all
    """
    file = Path(path)
    model = read(file)
    found = list(problems(model))
    if not found:
        found = list(_sidecar(file, properties(model)))
    return tuple(
        Finding(
            check=f"facepipe:{one.check}",
            severity="error" if one.check != "OnnxSidecarMissing" else "warning",
            where=f"{file.name} -> {one.where}",
            message=one.message,
        )
        for one in found
    )


def _sidecar(file: Path, stored: dict[str, str]) -> Iterator[Problem]:
    beside = sidecar.path_of(file)
    if not beside.exists():
        yield Problem("OnnxSidecarMissing", beside.name, "no such file, expected the metadata beside the model")
        return
    try:
        text = read_bytes(beside, MAX_BYTES)
        same = sidecar.parse(text, beside.name) == sidecar.from_properties(stored)
    except InputError as error:
        yield Problem("OnnxSidecar", error.where, error.what)
        return
    if not same:
        yield Problem("OnnxSidecar", beside.name, "differs from the metadata in the model")
