"""Folders that tests look in."""

from __future__ import annotations

import sys
from pathlib import Path

SUPPORT = Path(__file__).resolve().parent
REPOSITORY = SUPPORT.parents[1]
SHARED = REPOSITORY.parent / "shared" / "data"

sys.path += [str(folder) for folder in sorted(SUPPORT.parent.rglob("*")) if any(folder.glob("test_*.py"))]
