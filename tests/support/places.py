"""Folders that tests look in."""

from __future__ import annotations

from pathlib import Path

SUPPORT = Path(__file__).resolve().parent
REPOSITORY = SUPPORT.parents[1]
SHARED = REPOSITORY.parent / "shared" / "data"
