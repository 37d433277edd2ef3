"""Names of a glTF document: as they are, and as identifiers where they have to be."""

from __future__ import annotations

import unicodedata
from collections import Counter

from facepipe.core import names
from facepipe_gltf.read.values import Value

_LONGEST = 80


def given_name(value: Value) -> str | None:
    """The name that an object of the document has, exactly; None where it has none."""
    name = value.get("name")
    return None if name is None else name.name()


def file_name(name: str, fallback: str) -> str:
    """`name` as letters of ASCII, digits and underscores, for files.

    Accents are dropped, other characters beyond ASCII become ``u`` and their hexadecimal code, so that names in
    other scripts stay apart; the rest becomes ``_``. An empty name is `fallback`.
    """
    plain = unicodedata.normalize("NFKD", name[: 4 * _LONGEST])
    safe = "".join(_safe(character) for character in plain if not unicodedata.combining(character))[:_LONGEST]
    return names.identifier(safe, fallback)


class Names:
    """Hands out names, each once: one that is taken gets ``_2``, ``_3`` ... behind it."""

    def __init__(self) -> None:
        self._taken: set[str] = set()
        self._next: Counter[str] = Counter()
        self._known: dict[tuple[str, int], str] = {}

    def new(self, base: str) -> str:
        """`base`, or the first numbered name after it that is free."""
        result = base
        while result in self._taken:
            self._next[base] += 1
            result = f"{base}_{self._next[base] + 1}"
        self._taken.add(result)
        return result

    def same(self, name: str, occurrence: int) -> str:
        """The name of the n-th thing called `name`: always the same one for the same two."""
        key = (name, occurrence)
        if key not in self._known:
            self._known[key] = self.new(name)
        return self._known[key]


def joint_identifier(name: str) -> str:
    """The part of a joint's path that stands for `name`."""
    return names.identifier(name[:_LONGEST], "joint")


def _safe(character: str) -> str:
    return character if character.isascii() else f"u{ord(character):x}_"
