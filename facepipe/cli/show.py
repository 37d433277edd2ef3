"""What commands print: tables, JSON, progress."""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from facepipe.core.errors import printable
from facepipe.core.reports import Report


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


def emit(value: Report | dict[str, Any], text: str, *, as_json: bool) -> None:
    """Print the JSON of a result, or its text."""
    if as_json:
        print(
            value.to_json() if isinstance(value, Report) else json.dumps(value, sort_keys=True, indent=2, default=str)
        )
    else:
        print("\n".join(map(printable, text.split("\n"))))


def warn(lines: Iterable[str]) -> None:
    """Print warnings to stderr, a line each."""
    for line in lines:
        note(f"warning: {line}")


def note(line: str) -> None:
    """Print a fact to stderr."""
    print(f"facepipe: {printable(line)}", file=sys.stderr)


@contextlib.contextmanager
def progress(label: str, total: int) -> Iterator[Any]:
    """A bar on stderr with ``update()`` per step; shown on a terminal only."""
    from tqdm import tqdm

    with tqdm(total=total, desc=label, file=sys.stderr, disable=None, leave=False) as bar:
        yield bar
