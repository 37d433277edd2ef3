"""Files with recipes, in the order in which they depend on each other, and why one has to be cooked."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from facepipe.actions import cookable, cookables
from facepipe.core.errors import FacepipeError, InputError
from facepipe.core.policy.paths import check_readable, is_writable, real_path, roots_of
from facepipe.core.reading import digest
from facepipe.parts import Recipe
from facepipe.stage.files import SUFFIXES, check_stage_file
from facepipe.stage.recipes import check_recipe, file_recipe, is_source, layer_links, named_source, source_files

_IMPORT = "import "  # its faces are taken as they are
_ENDS = 8  # files at each end of a trail that are named


@dataclass(frozen=True, kw_only=True)
class Node:
    """A USD file; it stands on layers, and with a recipe is made of sources."""

    path: Path  # absolute
    recipe: Recipe | None
    sources: tuple[Path, ...] = ()  # of the recipe, in its order
    layers: tuple[Path, ...] = ()  # that the file names

    @property
    def below(self) -> tuple[Path, ...]:
        """The USD files that it is made of."""
        files = (*self.sources, *self.layers)
        return tuple(file for file in files if file.suffix.lower() in SUFFIXES and file.is_file())

    @property
    def lost(self) -> tuple[Path, ...]:
        """Layers that are not there."""
        return tuple(layer for layer in self.layers if not layer.is_file())


@dataclass(frozen=True, kw_only=True)
class Graph:
    """All USD files that some depend on."""

    nodes: dict[Path, Node]  # resolved path -> its node; what one depends on stands before it
    roots: dict[Path, tuple[Path, ...]]  # resolved path -> roots of a stage that led to it, where it lies below them

    def cookable(self) -> tuple[Node, ...]:
        """Those with recipes, in order."""
        return tuple(node for node in self.nodes.values() if node.recipe is not None)

    def holds(self, node: Node) -> bool:
        """Whether all that `node` is made of is here."""
        return all(one.resolve() in self.nodes for one in node.below)

    def made_of(self, path: Path) -> set[Path]:
        """Resolved paths of a file and of all layers below it."""
        files, left = set(), [path.resolve()]
        while left:
            file = left.pop()
            if file not in files:
                files.add(file)
                left += [layer.resolve() for layer in self.nodes[file].layers] if file in self.nodes else []
        return files


def read_graph(paths: Iterable[Path]) -> Graph:
    """The files at `paths` with all layers that they stand on and all sources of recipes, recursively.

    :raises InputError: a file that is gone, a recipe that nothing here can cook, or files that depend on each other
        around a circle, with their names
    :raises SchemaError: a damaged recipe, or one of a newer facepipe
    """
    walk, starts = _Walk(), []
    for path in paths:
        check_stage_file(path)
        # of a link to a file beside it, that file is read and written. Links elsewhere are kept: USD looks for layers
        # from the folder of the link
        path = Path(os.path.abspath(path))  # noqa: PTH100  (links to folders stay as they are)
        meant = path.resolve()
        starts.append(path.with_name(meant.name) if meant.parent == path.parent.resolve() else path)
        walk.visit(starts[-1])
    return Graph(nodes=walk.done, roots=_writable(walk.done, starts))


def _writable(nodes: dict[Path, Node], starts: Iterable[Path]) -> dict[Path, tuple[Path, ...]]:
    """Resolved paths of nodes that may be written, and for each the roots of a stage that allows it."""
    writable: dict[Path, tuple[Path, ...]] = {}
    stages: dict[tuple[Path, ...], list[Path]] = {}
    for start in starts:
        stages.setdefault(roots_of(start), []).append(start.resolve())
    for roots, left in stages.items():
        seen = set(left)
        while left:
            key = left.pop()
            if key not in writable and is_writable(nodes[key].path, roots):
                writable[key] = roots
            below = {one for one in map(Path.resolve, nodes[key].below) if one in nodes and one not in seen}
            seen |= below
            left += below
    return writable


def shown(path: Path) -> str:
    """A path as seen from the working folder, where it lies below that."""
    folder = Path.cwd()
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else str(path)


class _Walk:
    """Depth first, each file once."""

    def __init__(self) -> None:
        self.done: dict[Path, Node] = {}
        self._trail: dict[Path, Node] = {}  # resolved path -> node, from the first file to the one that is read

    def visit(self, path: Path) -> None:
        """Read a file and all below it, in chains that may be longer than Python's stack."""
        left = [iter([path])]
        while True:
            following = next(left[-1], None)
            if following is not None:
                left += self._entered(following)
                continue
            left.pop()
            if not left:
                return
            key, node = self._trail.popitem()
            self.done[key] = node

    def _entered(self, path: Path) -> list[Iterator[Path]]:
        """The files that one is made of; nothing where it is done."""
        key = path.resolve()
        if key in self.done:
            return []
        if key in self._trail:
            circle = [*self._paths()[list(self._trail).index(key) :], path]
            raise InputError(_line(circle), "depends on itself, expected sources that do not")
        try:
            node = read_node(path)
        except FacepipeError as error:
            raise (error.under(_line(self._paths())) if self._trail else error) from None
        for number, source in enumerate(node.sources, 1):
            if not is_source(source):
                place = _line([*self._paths(), node.path])
                raise InputError(f"{place} -> source {number}", f"{shown(source)}: no such file, expected it there")
        if node.recipe is None and node.lost:
            place = _line([*self._paths(), node.path])
            raise InputError(place, f"stands on {shown(node.lost[0])}, which is gone, expected it there")
        self._trail[key] = node
        return [iter(node.below)]

    def _paths(self) -> list[Path]:
        return [node.path for node in self._trail.values()]


def read_node(path: Path) -> Node:
    """The node of one USD file.

    :raises InputError: a damaged file, a recipe that nothing here can cook or that names models that can hold code, or
        reads that are confined to elsewhere
    :raises SchemaError: a damaged recipe, or one of a newer facepipe
    """
    check_readable(path)
    links = layer_links(path)
    recipe = file_recipe(path).recipe if links.has_recipe else None
    made_of = recipe is not None and (recipe.sources or recipe.digests)
    if recipe is None or not made_of or recipe.verb.startswith(_IMPORT):
        return Node(path=path, recipe=None, layers=links.layers)
    where = f"{shown(path)} -> recipe"
    check_recipe(where, recipe)
    try:
        kind = cookable(recipe.verb)
    except InputError as error:  # of a plug-in that can't be used
        raise error.under(where) from None
    if kind is None:
        verbs = ", ".join(cookables())
        raise InputError(where, f"is of '{recipe.verb[:40]}', expected one of {verbs}")
    named = [named_source(f"{where} -> source {number}", one, path) for number, one in enumerate(recipe.sources, 1)]
    sources = tuple(map(_plain, named))
    for source in sources:
        check_readable(source)
    return Node(path=path, recipe=recipe, sources=sources, layers=links.layers)


def _plain(path: Path) -> Path:
    """A path without ``..``, unless links make it another."""
    plain = Path(os.path.normpath(path))
    return plain if real_path(plain) == real_path(path) else path


def _line(trail: Sequence[Path]) -> str:
    """Files that led to each other; of very many the first and the last."""
    names = [shown(one) for one in trail]
    return " -> ".join(names if len(names) <= 2 * _ENDS else [*names[:_ENDS], "...", *names[-_ENDS:]])


class Digests:
    """Digests of sources, each found once until something that it covers is written."""

    def __init__(self) -> None:
        self._found: dict[Path, tuple[str, set[Path]]] = {}

    def digest_of(self, path: Path) -> str:
        """:raises InputError: a file can't be read"""
        if path not in self._found:
            files = source_files(path)
            self._found[path] = digest(files), {file.resolve() for file in files}
        return self._found[path][0]

    def forget(self, written: Path) -> None:
        """Forget the digests that cover the file at a resolved path: it has been written."""
        self._found = {path: one for path, one in self._found.items() if written not in one[1]}

    def forget_all(self) -> None:
        """Forget all: another process may have written any file."""
        self._found = {}


def changes(graph: Graph, node: Node, digests: Digests, cooked: Collection[Path]) -> tuple[str, ...]:
    """A line for each source and layer that has changed since `node` was made.

    :param cooked: resolved paths of files that were written meanwhile
    :raises InputError: a source can't be read
    """
    lines = []
    before = node.recipe.digests if node.recipe else ()
    for source, old in zip(node.sources, before, strict=True):
        if digests.digest_of(source) != old:
            made = any(one in cooked for one in graph.made_of(source))
            lines.append(f"{source.name} was cooked and changed" if made else f"{source.name} changed")
    return (*lines, *(f"{one.name}, which it stands on, is lost" for one in node.lost))


def waiting(graph: Graph, node: Node, stale: Collection[Path]) -> tuple[str, ...]:
    """A line for each source that is one of `stale` or stands on one."""
    found = [source for source in node.sources if any(one in stale for one in graph.made_of(source))]
    return tuple(f"{source.name} is to be cooked" for source in found)
