"""How much a file may ask for: what costs nothing to name again is granted once and counted every time."""

from __future__ import annotations

import os
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from facepipe.core.errors import InputError

# Prims of a face, of the kinds that each take a good part of a millisecond to read.
MOST_OF = {"BlendShape": 10_000, "Shader": 8192, "NodeGraph": 8192, "Material": 4096, "Mesh": 4096, "GeomSubset": 4096}


@dataclass
class Budget:
    """What reading may still take: `left`, and `per_byte` more for each byte that the files really hold."""

    left: int
    per_byte: int = 0
    held: int = 0  # bytes of the files, so far
    _granted: set[Hashable] = field(default_factory=set)

    def grant(self, size: int, source: Hashable) -> None:
        """Allow for `size` bytes of a source, once however often it is named."""
        if source not in self._granted:
            self._granted.add(source)
            self.left += self.per_byte * size
            self.held += size

    def check(self, size: int, error: Callable[[str], Exception]) -> None:
        """Check that `size` is left.

        :param error: of a text: what is raised where it is not
        """
        if self.left < size:
            raise error("the file asks for far more data than it holds")

    def spend(self, size: int, error: Callable[[str], Exception]) -> None:
        """Take `size`, as `check` says."""
        self.check(size, error)
        self.left -= size


def same_file(path: Path) -> Hashable:
    """A key that all names of one file share, links of either kind; the path itself where it can't be looked at."""
    try:
        state = os.stat(path)  # noqa: PTH116  (as fast as can be: it is asked for each name)
    except (OSError, ValueError):
        return str(path)
    return (state.st_dev, state.st_ino)


def check_counts(where: object, counts: Mapping[str, int]) -> None:
    """Check how many of each kind of prim a face has.

    :raises InputError: more than a face can have
    """
    for kind, count in counts.items():
        if count > MOST_OF.get(kind, count):
            raise InputError(where, f"{count} prims of type {kind}, expected at most {MOST_OF[kind]}")
