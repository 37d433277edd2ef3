"""Names as USD identifiers, and names chosen by globs."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from fnmatch import fnmatchcase

from facepipe.errors import InputError


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


def select(names: Sequence[str], globs: str, option: str) -> tuple[str, ...]:
    """The `names` that one of the comma-separated `globs` matches, in their order; none where there is no glob.

    >>> select(("jawOpen", "browUp", "jawLeft"), "jaw*", "shapes")
    ('jawOpen', 'jawLeft')

    :param option: what the globs were given as, for messages
    :raises InputError: a glob other than ``*`` that matches none
    """
    patterns = [glob.strip() for glob in globs.split(",") if glob.strip()]
    for pattern in patterns:
        if pattern != "*" and not any(fnmatchcase(name, pattern) for name in names):
            some = ", ".join(names[:4]) + (" ..." if len(names) > 4 else "") or "none, there are none"
            raise InputError(f"option {option}", f"'{pattern}' matches none of {len(names)}, expected some of: {some}")
    return tuple(name for name in names if any(fnmatchcase(name, pattern) for pattern in patterns))
