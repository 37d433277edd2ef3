"""Names as USD identifiers."""

from __future__ import annotations

import re
from collections.abc import Iterable


def identifier(text: str, fallback: str = "unnamed") -> str:
    """`text` as a USD identifier: letters, digits and underscores of ASCII, no digit first.

    >>> identifier("breast.L"), identifier("2nd tooth"), identifier("")
    ('breast_L', '_2nd_tooth', 'unnamed')
    """
    safe = re.sub(r"[^A-Za-z0-9_]", "_", text.strip())
    if not safe:
        return fallback
    return f"_{safe}" if safe[0].isdigit() else safe


def unique_identifiers(names: Iterable[str], fallback: str = "unnamed") -> tuple[str, ...]:
    """Identifiers for `names`, in order; a name already taken gets the next free ``_2``, ``_3`` ..."""
    taken: set[str] = set()
    result = []
    for name in names:
        base = candidate = identifier(name, fallback)
        number = 2
        while candidate in taken:
            candidate, number = f"{base}_{number}", number + 1
        taken.add(candidate)
        result.append(candidate)
    return tuple(result)
