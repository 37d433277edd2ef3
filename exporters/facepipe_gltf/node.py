"""Where node is, which runs what others wrote for it alone."""

from __future__ import annotations

import shutil
from pathlib import Path


def find_node() -> str | None:
    """The program node of the PATH; None where there is none.

    Windows looks in the working folder first, and a downloaded folder must not bring programs along.
    """
    found = shutil.which("node")
    return found if found and Path(found).is_absolute() else None
