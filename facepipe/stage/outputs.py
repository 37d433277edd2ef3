"""Where results may be written."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from facepipe.core.atomic import collect
from facepipe.core.errors import InputError
from facepipe.stage.files import SUFFIXES, dependencies


def check_output(output: Path, inputs: Sequence[Path], *, overwrite: bool) -> None:
    """Check a place before any work is done for it; what a killed run left beside it is settled first.

    :raises InputError: no folder, an input or a layer or texture of one, or a file that may not be overwritten
    """
    if not output.parent.is_dir():
        raise InputError(output, "the folder does not exist")
    collect(output.parent)
    if output.is_dir():
        raise InputError(output, "is a folder, expected a file")
    if any(one.exists() and output.exists() and output.samefile(one) for one in inputs):
        raise InputError(output, "is an input, expected another output file")
    if output.exists() and not overwrite:
        raise InputError(output, "exists, expected a new file (or --force)")
    if output.exists():
        _check_not_needed(output, inputs)


def _check_not_needed(output: Path, inputs: Sequence[Path]) -> None:
    """:raises InputError: `output` is a layer or texture of a stage among the inputs"""
    for one in inputs:
        if one.is_file() and one.suffix.lower() in SUFFIXES:
            for needed in dependencies(one):
                if needed.exists() and output.samefile(needed):
                    raise InputError(output, f"is needed by {one}, expected another output file")
