"""Folders that a command makes as its report."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from facepipe.core.errors import InputError

REPORT = "report.json"


def check_report_folder(
    folder: Path, *, force: bool, taken: Sequence[Path], known: re.Pattern[str], command: str
) -> None:
    """Check that a report may be written as `folder`: that it is new, or with `force` a report from before.

    :param taken: files and folders that must not be in it: inputs and outputs
    :param known: names, with "/" below the folder, that a report of `command` has
    :raises InputError: it may not
    """
    place = folder.resolve()
    if not place.parent.is_dir():
        raise InputError(folder, "the folder around it does not exist")
    if place.exists() and not place.is_dir():
        raise InputError(folder, "is a file, expected a folder to make")
    inside = next((one for one in taken if place in one.resolve().parents or place == one.resolve()), None)
    if inside is not None:
        raise InputError(folder, f"holds {inside.name}, which is read or written too, expected another folder")
    if not place.exists():
        return
    if not force:
        raise InputError(folder, "exists, expected a new folder (or --force)")
    names = sorted(one.relative_to(place).as_posix() for one in place.rglob("*"))
    foreign = [name for name in names if not known.fullmatch(name)]
    if foreign or (names and REPORT not in names):
        found = f"holds {foreign[0]}" if foreign else f"has no {REPORT}"
        raise InputError(folder, f"{found}, expected an empty folder or a report of {command} to replace")
