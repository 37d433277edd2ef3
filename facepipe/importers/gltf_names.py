"""Names of a glTF document as USD identifiers."""

from __future__ import annotations

import unicodedata
from collections import Counter

from facepipe import names

_LONGEST = 80


def identifier(name: str, fallback: str) -> str:
    """`name` as an ASCII USD identifier.

    Accents are dropped, other characters beyond ASCII become ``u`` and their hexadecimal code, so that names in
    other scripts stay apart; the rest becomes ``_``. An empty name is `fallback`.
    """
    plain = unicodedata.normalize("NFKD", name[: 4 * _LONGEST])
    safe = "".join(_safe(character) for character in plain if not unicodedata.combining(character))[:_LONGEST]
    return names.identifier(safe, fallback)


class Names:
    """Hands out identifiers, each once: a name that is taken gets ``_2``, ``_3`` ... behind it."""

    def __init__(self, *reserved: str) -> None:
        self._taken = set(reserved)
        self._next: Counter[str] = Counter()
        self._known: dict[tuple[str, int], str] = {}

    def new(self, name: str, fallback: str) -> str:
        """An identifier for `name` that was not handed out before."""
        base = identifier(name, fallback)
        result = base
        while result in self._taken:
            self._next[base] += 1
            result = f"{base}_{self._next[base] + 1}"
        self._taken.add(result)
        return result

    def same(self, name: str, occurrence: int, fallback: str) -> str:
        """The identifier of the n-th thing called `name`: always the same one for the same two."""
        key = (name, occurrence)
        if key not in self._known:
            self._known[key] = self.new(name, fallback)
        return self._known[key]


def _safe(character: str) -> str:
    return character if character.isascii() else f"u{ord(character):x}_"
