"""Named checks of faces and of what is exported from them.

Importing this package registers the stage checks with UsdValidation, where this USD takes checks written in Python.
"""

from __future__ import annotations

import os
from pathlib import Path

from facepipe.checks.checks import CHECKS, Check, check_built_in, check_stage, register
from facepipe.core.errors import InputError
from facepipe.core.reports import Finding
from facepipe.registry import exporter, suffixes
from facepipe.stage.array_files import check_arrays_there
from facepipe.stage.files import SUFFIXES, lower_levels, open_stage, quiet_diagnostics

__all__ = ["CHECKS", "Check", "Finding", "check_stage", "register", "validate", "validate_stage"]

register()


def validate(path: str | os.PathLike[str]) -> tuple[Finding, ...]:
    """Check a face stage, a glTF file or an ONNX file; no finding means that it is good.

    :raises InputError: no such file, a suffix that nothing here checks, or a file too damaged to open
    """
    file = Path(path)
    if not file.is_file():
        raise InputError(file, "no such file" if not file.exists() else "is no regular file")
    suffix = file.suffix.lower()
    if suffix in SUFFIXES:
        return validate_stage(file)
    if suffix.removeprefix(".") not in suffixes():
        expected = " ".join([*SUFFIXES, *(f".{one}" for one in suffixes())])
        raise InputError(file, f"suffix '{file.suffix}', expected one of {expected}")
    return tuple(exporter(file).validate(file))


def validate_stage(path: str | os.PathLike[str]) -> tuple[Finding, ...]:
    """Check a USD file by our checks and by USD's own validators, at each of its levels of detail.

    :raises InputError: no such file, no readable USD, or one without the file of its arrays
    """
    with quiet_diagnostics():
        stage = open_stage(path, strict=False)
        check_arrays_there(stage)
        findings = check_stage(stage) + check_built_in(stage)
        for level in lower_levels(stage):
            findings += [one for one in check_stage(level) + check_built_in(level) if one not in findings]
        return tuple(findings)
