"""Why a file with a recipe has to be cooked."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from facepipe.cooking.graph import Graph, Node
from facepipe.core.digests import digest
from facepipe.stage.recipes import source_files


class Digests:
    """Digests of sources, each found once until something that it covers is written."""

    def __init__(self) -> None:
        self._found: dict[Path, tuple[str, set[Path]]] = {}

    def of(self, path: Path) -> str:
        """:raises InputError: a file can't be read"""
        if path not in self._found:
            files = source_files(path)
            self._found[path] = digest(files), {one.resolve() for one in files}
        return self._found[path][0]

    def forget(self, written: Path) -> None:
        """The file at a resolved path is another now."""
        self._found = {path: one for path, one in self._found.items() if written not in one[1]}

    def forget_all(self) -> None:
        """Another process may have written anything."""
        self._found = {}


def changes(graph: Graph, node: Node, digests: Digests, cooked: Collection[Path]) -> tuple[str, ...]:
    """A line for each thing that is not what it was when `node` was made.

    :param cooked: resolved paths of files that were written meanwhile
    :raises InputError: a source can't be read
    """
    lines = []
    before = node.recipe.digests if node.recipe else ()
    for source, old in zip(node.sources, before, strict=True):
        if digests.of(source) != old:
            made = any(one in cooked for one in graph.made_of(source))
            lines.append(f"{source.name} was cooked and changed" if made else f"{source.name} changed")
    return (*lines, *(f"{one.name}, which it stands on, is lost" for one in node.lost))


def waiting(graph: Graph, node: Node, stale: Collection[Path]) -> tuple[str, ...]:
    """A line for each source that is one of `stale` or stands on one."""
    found = [source for source in node.sources if any(one in stale for one in graph.made_of(source))]
    return tuple(f"{source.name} is to be cooked" for source in found)
