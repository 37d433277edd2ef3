"""Notebooks, run without Jupyter: their code cells one after another in one namespace."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any


def cells(notebook: Path) -> list[dict[str, Any]]:
    """The code cells."""
    content = json.loads(notebook.read_text(encoding="utf-8"))
    return [cell for cell in content["cells"] if cell["cell_type"] == "code"]


def run_cells(notebook: Path) -> dict[str, Any]:
    """The names that its cells leave behind; files are relative to the working folder."""
    names: dict[str, Any] = {"__name__": "__main__"}
    for number, cell in enumerate(cells(notebook), 1):
        exec(compile("".join(cell["source"]), f"{notebook.name}, cell {number}", "exec"), names)
    return names
