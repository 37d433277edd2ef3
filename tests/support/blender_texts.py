"""Text blocks as Blender has them, as far as records of faces need one."""

from __future__ import annotations

from typing import Any


class TextBlock(dict[str, Any]):
    """Properties by name, and a text."""

    name = "face.usda"

    def from_string(self, text: str) -> None:
        """Readable lines, which nobody reads back."""
