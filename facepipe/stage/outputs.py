"""Where results may be written."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from facepipe.core.atomic import collect
from facepipe.core.errors import InputError
from facepipe.core.policy.paths import check_written
from facepipe.stage.files import SUFFIXES, dependencies

_REPORT_FILE = "report.json"


def check_output(output: Path, inputs: Sequence[Path], *, overwrite: bool) -> None:
    """Check a place before any work is done for it; what a killed run left beside it is cleaned up first.

    :raises InputError: no folder, an input or a layer or texture of one, a file that may not be overwritten, or a link
        that leads out of the roots
    """
    check_written(output)
    if not output.parent.is_dir():
        raise InputError(output, "the folder does not exist")
    collect(output.parent)
    if output.is_dir():
        raise InputError(output, "is a folder, expected a file")
    if any(given.exists() and output.exists() and output.samefile(given) for given in inputs):
        raise InputError(output, "is an input, expected another output file")
    if output.exists() and not overwrite:
        raise InputError(output, "exists, expected a new file (or --force)")
    if output.exists():  # with --force a layer below an input would be lost, and the result with it
        for stage in inputs:
            if stage.is_file() and stage.suffix.lower() in SUFFIXES:
                for needed in dependencies(stage):
                    if needed.exists() and output.samefile(needed):
                        raise InputError(output, f"is needed by {stage}, expected another output file")


def check_report_folder(
    folder: Path, *, overwrite: bool, taken: Sequence[Path], known: re.Pattern[str], command: str
) -> None:
    """Check that a report may be written as `folder`: that it is new, or with `overwrite` a report from before.

    :param taken: files and folders that must not be in it: inputs and outputs
    :param known: names, with "/" below the folder, that a report of `command` has
    :raises InputError: it may not
    """
    check_written(folder)
    place = folder.resolve()
    if not place.parent.is_dir():
        raise InputError(folder, "the folder around it does not exist")
    if place.exists() and not place.is_dir():
        raise InputError(folder, "is a file, expected a folder to make")
    inside = next((path for path in taken if place in path.resolve().parents or place == path.resolve()), None)
    if inside is not None:
        raise InputError(folder, f"holds {inside.name}, which is read or written too, expected another folder")
    if not place.exists():
        return
    if not overwrite:
        raise InputError(folder, "exists, expected a new folder (or --force)")
    # --force replaces a whole folder: one that holds anything but a report may be of use to someone
    names = sorted(path.relative_to(place).as_posix() for path in place.rglob("*"))
    foreign = [name for name in names if not known.fullmatch(name)]
    if foreign or (names and _REPORT_FILE not in names):
        found = f"holds {foreign[0]}" if foreign else f"has no {_REPORT_FILE}"
        raise InputError(folder, f"{found}, expected an empty folder or a report of {command} to replace")
