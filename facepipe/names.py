"""Names as USD identifiers, names chosen by globs, and the names that a wrong one may have meant."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Sequence
from difflib import get_close_matches
from fnmatch import fnmatchcase

from facepipe.errors import InputError

_LONGEST_LIKE = 200  # characters of a wrong name that are compared


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


def did_you_mean(name: str, known: Collection[str]) -> str:
    """The end of a message about a name that is not there: the known one that is most like it, or nothing.

    >>> did_you_mean("jawopn", ["jawOpen", "jawLeft"]), did_you_mean("tail", ["jawOpen"])
    (", did you mean 'jawOpen'?", '')
    """
    folded = {one.casefold(): one for one in reversed(list(known))}
    near = get_close_matches(name[:_LONGEST_LIKE].casefold(), folded, n=1)
    return f", did you mean '{folded[near[0]]}'?" if near else ""


def find(name: str, known: Collection[str], where: object, what: str) -> str:
    """The known name that is `name`, or alone differs from it in case.

    :param where: what the name was given as, and `what` it should be one of, for messages
    :raises InputError: no such name, or only ones that differ in case alone
    """
    if name in known:
        return name
    alike = [one for one in known if one.casefold() == name.casefold()]
    if len(alike) == 1:
        return alike[0]
    if alike:
        raise InputError(where, f"no {what} '{name}', but {len(alike)} that differ in case, like '{alike[0]}'")
    some = ", ".join(list(known)[:4]) + (" ..." if len(known) > 4 else "") or "none, there are none"
    raise InputError(where, f"no {what} '{name}'{did_you_mean(name, known) or f', expected one of: {some}'}")
