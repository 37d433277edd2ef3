"""Layers written by hand, or edited as text; attributes of stages to edit."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pxr import Usd


def prim(name: str, arcs: str = "", inside: str = "") -> str:
    metadata = f"({arcs})" if arcs else ""
    return f'def "{name}" {metadata}\n{{\n{inside}\n}}\n'


def write(folder: Path, layers: dict[str, str]) -> Path:
    """The layers in a folder; the first of them."""
    for name, text in layers.items():
        content = text if text.startswith("#") else f'#usda 1.0\n(defaultPrim = "a0")\n{text}'
        (folder / name).write_text(content)
    return folder / next(iter(layers))


def with_options(change: Callable[[dict[str, Any]], object]) -> Callable[[str], str]:
    """An edit of the recipe's options in the text of a layer: a text that `change` gives takes their place."""

    def edit(text: str) -> str:
        (old,) = re.findall(r"facepipe:recipe:options = '(.*)'", text)
        options = json.loads(old)
        changed = change(options)
        return text.replace(old, changed if isinstance(changed, str) else json.dumps(options))

    return edit


def attribute(stage: Usd.Stage, path: str) -> Usd.Attribute:
    """An attribute that is there."""
    found = stage.GetAttributeAtPath(path)
    assert found, path
    return found
