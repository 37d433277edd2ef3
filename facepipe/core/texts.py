"""Text for people."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def table(rows: Iterable[Sequence[object]]) -> str:
    """Rows as aligned columns; numbers to the right."""
    texts = [[str(cell) for cell in row] for row in rows]
    if not texts:
        return ""
    widths = [max(len(row[i]) for row in texts if i < len(row)) for i in range(max(map(len, texts)))]
    return "\n".join(
        "  ".join(_cell(cell, width) for cell, width in zip(row, widths, strict=False)).rstrip() for row in texts
    )


def _cell(text: str, width: int) -> str:
    return text.rjust(width) if text.replace(".", "").replace(",", "").replace("-", "").isdigit() else text.ljust(width)
