"""Cells and columns of the tables that benchmarks print."""

from __future__ import annotations

from collections.abc import Sequence


def aligned(rows: Sequence[tuple[str, ...]]) -> list[str]:
    """Lines of columns, two of them flush left; a rule where the first cell changes, which shows once."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines: list[str] = []
    shown = ""
    for row in rows:
        first = row[0] if row[0] != shown else ""
        shown = row[0]
        cells = [first.ljust(widths[0]), row[1].ljust(widths[1])]
        cells += [cell.rjust(width) for cell, width in zip(row[2:], widths[2:], strict=True)]
        if first and lines:
            lines.append("-" * (sum(widths) + 2 * (len(widths) - 1)))
        lines.append("  ".join(cells).rstrip())
    return lines


def ms(seconds: float | None) -> str:
    """Milliseconds."""
    return "" if seconds is None else f"{seconds * 1000:,.1f} ms"


def mib(size: float | None) -> str:
    """MiB of a number of bytes."""
    return "" if size is None else f"{size / 2**20:,.1f} MiB"


def times(ratio: float | None) -> str:
    """A ratio."""
    return "" if ratio is None else f"{ratio:.2f}x"


def verdict(what: str, value: float, aim: float) -> str:
    """A figure beside the most that it should be."""
    return f"{what}: {value:.3f}, aim {aim:g}{'' if value <= aim else ': missed'}"
