"""Layers written by hand."""

from __future__ import annotations

from pathlib import Path


def prim(name: str, arcs: str = "", inside: str = "") -> str:
    metadata = f"({arcs})" if arcs else ""
    return f'def "{name}" {metadata}\n{{\n{inside}\n}}\n'


def write(folder: Path, layers: dict[str, str]) -> Path:
    """The layers in a folder; the first of them."""
    for name, text in layers.items():
        content = text if text.startswith("#") else f'#usda 1.0\n(defaultPrim = "a0")\n{text}'
        (folder / name).write_text(content)
    return folder / next(iter(layers))
