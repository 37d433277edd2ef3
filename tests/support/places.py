"""Folders that tests look in."""

from __future__ import annotations

from pathlib import Path

SUPPORT = Path(__file__).resolve().parent
REPOSITORY = SUPPORT.parents[1]
SHARED = REPOSITORY.parent / "shared" / "data"


def names(folder: Path) -> list[str]:
    """What is in a folder and below it, sorted."""
    return sorted(one.relative_to(folder).as_posix() for one in folder.rglob("*"))
