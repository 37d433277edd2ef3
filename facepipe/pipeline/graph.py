"""Files with recipes, in the order that they depend on each other."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from facepipe.errors import FacepipeError, InputError
from facepipe.parts import Recipe
from facepipe.pipeline.verbs import VERBS
from facepipe.stage.files import SUFFIXES
from facepipe.stage.layer_links import layer_links
from facepipe.stage.recipes import check_recipe, file_recipe

_IMPORT = "import "  # its faces are taken as they are


@dataclass(frozen=True, kw_only=True)
class Node:
    """A USD file: one with a recipe is made of its sources, any stands on layers."""

    path: Path  # absolute
    recipe: Recipe | None
    sources: tuple[Path, ...] = ()  # of the recipe, in its order
    layers: tuple[Path, ...] = ()  # that the file names

    @property
    def below(self) -> tuple[Path, ...]:
        """The USD files that it is made of."""
        files = (*self.sources, *self.layers)
        return tuple(one for one in files if one.suffix.lower() in SUFFIXES and one.is_file())

    @property
    def lost(self) -> tuple[Path, ...]:
        """Layers that are not there."""
        return tuple(one for one in self.layers if not one.is_file())


@dataclass(frozen=True, kw_only=True)
class Graph:
    """All USD files that some depend on."""

    nodes: dict[Path, Node]  # resolved path -> its node; what one depends on stands before it

    def cookable(self) -> tuple[Node, ...]:
        """Those with recipes, in order."""
        return tuple(one for one in self.nodes.values() if one.recipe is not None)

    def holds(self, node: Node) -> bool:
        """Whether all that `node` is made of is here."""
        return all(one.resolve() in self.nodes for one in node.below)

    def made_of(self, path: Path) -> set[Path]:
        """Resolved paths of a file and of all layers below it."""
        found, left = set(), [path.resolve()]
        while left:
            one = left.pop()
            if one not in found:
                found.add(one)
                left += [layer.resolve() for layer in self.nodes[one].layers] if one in self.nodes else []
        return found


def read_graph(paths: Iterable[Path]) -> Graph:
    """The files at `paths` with all layers that they stand on and all sources of recipes, recursively.

    :raises InputError: a file that is gone, a recipe that nothing here can cook, or files that depend on each other
        around a circle, with their names
    :raises SchemaError: a damaged recipe, or one of a newer facepipe
    """
    walk = _Walk()
    for path in paths:
        _check_stage(path)
        walk.visit(_place(path), ())
    return Graph(nodes=walk.done)


def shown(path: Path) -> str:
    """A path as seen from the working folder, where it lies below that."""
    folder = Path.cwd()
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else str(path)


def _place(path: Path) -> Path:
    """The file that is read and written for a given path: of a link to one beside it, that one.

    USD looks for layers from the folder of a link, so that others are taken for files.
    """
    path = Path(os.path.abspath(path))  # noqa: PTH100  (links to folders stay as they are)
    meant = path.resolve()
    return path.with_name(meant.name) if meant.parent == path.parent.resolve() else path


def _check_stage(path: Path) -> None:
    if not path.is_file():
        raise InputError(path, "is no regular file, expected a USD file" if path.exists() else "no such file")
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(path, f"suffix '{path.suffix}', expected one of {' '.join(SUFFIXES)}")


class _Walk:
    """Depth first, each file once."""

    def __init__(self) -> None:
        self.done: dict[Path, Node] = {}

    def visit(self, path: Path, trail: tuple[Path, ...]) -> None:
        """:param trail: the files that led here"""
        key = path.resolve()
        if key in self.done:
            return
        keys = [one.resolve() for one in trail]
        if key in keys:
            circle = [*trail[keys.index(key) :], path]
            raise InputError(" -> ".join(map(shown, circle)), "depends on itself, expected sources that do not")
        try:
            node = read_node(path)
        except FacepipeError as error:
            raise _after(trail, error) from None
        self._check(node, trail)
        for one in node.below:
            self.visit(one, (*trail, path))
        self.done[key] = node

    def _check(self, node: Node, trail: tuple[Path, ...]) -> None:
        """:raises InputError: what it is made of is gone"""
        place = " -> ".join(map(shown, (*trail, node.path)))
        for number, source in enumerate(node.sources, 1):
            if not _is_file(source):
                raise InputError(f"{place} -> source {number}", f"{shown(source)}: no such file, expected it there")
        if node.recipe is None and node.lost:
            raise InputError(place, f"stands on {shown(node.lost[0])}, which is gone, expected it there")


def read_node(path: Path) -> Node:
    """What one USD file says.

    :raises InputError: a damaged file, or a recipe that nothing here can cook
    :raises SchemaError: a damaged recipe, or one of a newer facepipe
    """
    links = layer_links(path)
    recipe = file_recipe(path).recipe if links.has_recipe else None
    made_of = recipe is not None and (recipe.sources or recipe.digests)
    if recipe is None or not made_of or recipe.verb.startswith(_IMPORT):
        return Node(path=path, recipe=None, layers=links.layers)
    where = f"{shown(path)} -> recipe"
    check_recipe(where, recipe)
    if recipe.verb not in VERBS:
        raise InputError(where, f"is of '{recipe.verb[:40]}', expected one of {', '.join(VERBS)}")
    sources = tuple(Path(os.path.normpath(path.parent / source)) for source in recipe.sources)
    return Node(path=path, recipe=recipe, sources=sources, layers=links.layers)


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # a name that no file can have
        return False


def _after(trail: Sequence[Path], error: FacepipeError) -> FacepipeError:
    return error.under(" -> ".join(map(shown, trail))) if trail else error
