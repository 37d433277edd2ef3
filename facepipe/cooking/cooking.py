"""Recipes evaluated again where their sources have changed, in the order in which files depend on each other.

In order: the files with recipes and what each depends on; why one has to be cooked; the cook.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from facepipe.actions import cookable, cookables
from facepipe.cooking.report import Action, CookOptions, CookReport, NodeReport
from facepipe.core.atomic import collect
from facepipe.core.errors import FacepipeError, InputError
from facepipe.core.locks import discard_lock, locked
from facepipe.core.policy.paths import check_readable, is_writable, real_path, roots_of, trust, trusting
from facepipe.core.reading import digest
from facepipe.core.reports import Report, Watch, unwatched
from facepipe.parts import Recipe
from facepipe.performing import again
from facepipe.stage.files import SUFFIXES, check_stage_file
from facepipe.stage.recipes import check_recipe, file_recipe, is_source, layer_links, named_source, source_files

_IMPORT = "import "  # its faces are taken as they are
_ENDS = 8  # files at each end of a trail that are named
_TRIES = 3  # of a file whose sources change while it is made
AnyPath = str | os.PathLike[str]


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


def cook(
    paths: AnyPath | Sequence[AnyPath],
    options: CookOptions | None = None,
    *,
    watch: Watch = unwatched,
    on_node: Callable[[NodeReport], object] = lambda node: None,
) -> CookReport:
    """Bring the faces at `paths`, and all that they are made of, up to date.

    A file with a recipe is made anew where the digest of a source is not that of the recipe, or a layer that it stands
    on is lost; with the bytes that its command would write. A file that comes out as it was makes no other stale.
    Each file is written whole or not at all, by one process at a time: a cook that was killed is simply run again.
    Files outside the roots of the one of `paths` that led to them stay as they are.

    :param paths: files; or one
    :param watch: shows progress: called with a label and a number of steps for a context manager whose `update()` is
        called after each
    :param on_node: called with the report of each file, once it is done
    :raises FacepipeError: what can't be read or cooked; files that were cooked before it stay
    """
    start, options = time.perf_counter(), options or CookOptions()
    files = [Path(paths)] if isinstance(paths, str | os.PathLike) else [Path(path) for path in paths]
    run = _Run(read_graph(files), options, watch)
    nodes = []
    for node in run.nodes(files):
        nodes.append(node)
        on_node(node)
    findings = {}
    if options.validate:
        from facepipe.checks import validate

        findings = {str(path): validate(path) for path in files}
    warnings = tuple(f"{shown(one.file)}: {line}" for one in nodes for line in one.warnings)
    seconds = time.perf_counter() - start
    return CookReport(nodes=tuple(nodes), findings=findings, seconds=seconds, warnings=warnings)


class _Run:
    """One cook: what was written so far, and what would be."""

    def __init__(self, graph: Graph, options: CookOptions, watch: Watch) -> None:
        self.graph, self._options, self._watch = graph, options, watch
        self._digests = Digests()
        self._cooked: set[Path] = set()
        self._stale: set[Path] = set()
        self._outside: set[Path] = set()  # stale, and left so
        self._grown = False  # something is made of files that the graph lacks

    def nodes(self, files: Sequence[Path]) -> Iterator[NodeReport]:
        """Each file as it is done; again if a cooked file is now made of other files, which are cooked too.

        :raises FacepipeError: what can't be read or cooked
        """
        reported: set[Path] = set()
        while True:
            for node in self.graph.cookable():
                done = self.node(node)
                if node.path not in reported or done.action not in ("up to date", "outside the roots"):
                    yield done
                reported.add(node.path)
            if not self._grown:
                return
            self.graph, self._grown = read_graph(files), False

    def node(self, node: Node) -> NodeReport:
        """:raises FacepipeError: what can't be read or cooked"""
        key = node.path.resolve()
        roots = self.graph.roots.get(key)
        if roots and not self._options.dry_run:
            collect(node.path.parent)
            discard_lock(node.path)
        why = self._why(node)
        if not why:
            return _report(node, "up to date")
        if not roots:
            self._outside.add(key)
            return _report(node, "outside the roots", why)
        if self._options.dry_run:
            self._stale.add(key)
            return _report(node, "stale", why, self._old(node))
        with trusting(replace(trust(), roots=roots)), locked(node.path, waiting=self._digests.forget_all):
            start, node = time.perf_counter(), read_node(node.path)
            why = self._why(node)
            if not why or node.recipe is None:
                self._wrote(key)
                return _report(node, "up to date", ("another process cooked it",))
            report, missed = self._steady(node, node.recipe.verb, key)
            return replace(
                _report(node, "cooked", why),
                seconds=time.perf_counter() - start,
                missed=missed,
                warnings=(*self._old(node), *report.warnings),
                report=report.to_dict(),
            )

    def _why(self, node: Node) -> tuple[str, ...]:
        """Why `node` is to be cooked; nothing where it is up to date."""
        lines = []
        before = node.recipe.digests if node.recipe else ()
        for source, old in zip(node.sources, before, strict=True):
            if self._digests.digest_of(source) != old:
                made = any(one in self._cooked for one in self.graph.made_of(source))
                lines.append(f"{source.name} was cooked and changed" if made else f"{source.name} changed")
        lines += [f"{one.name}, which it stands on, is lost" for one in node.lost]
        for source in node.sources:
            if any(one in self._stale for one in self.graph.made_of(source)):
                lines.append(f"{source.name} is to be cooked")
        forced = self._options.force and node.path.resolve() not in self._cooked
        return tuple(lines) or (("forced",) if forced else ())

    def _old(self, node: Node) -> tuple[str, ...]:
        """A line for each stale file that `node` is made of all the same."""
        below = {one for source in node.sources for one in self.graph.made_of(source)}
        found = sorted(below & self._outside)
        return tuple(f"{one.name} is outside the roots and not up to date: taken as it is" for one in found)

    def _steady(self, node: Node, verb: str, key: Path) -> tuple[Report, bool]:
        """Cook; once more where a source has changed meanwhile: the recipe must be of what was read."""
        for _ in range(_TRIES):
            before = {source: self._digests.digest_of(source) for source in node.sources}
            try:
                kind = cookable(verb)
                if kind is None:
                    raise InputError(node.path, f"a recipe of '{verb[:40]}', expected one that can be cooked")
                cooked = again(node.path, kind, self._watch)
            except FacepipeError as error:
                raise error if str(node.path) in error.where else error.under(shown(node.path)) from None
            node = self._wrote(key)
            after = zip(node.sources, node.recipe.digests if node.recipe else (), strict=True)
            if all(before.get(source, digest) == digest for source, digest in after):
                return cooked
            self._digests.forget_all()
        raise InputError(
            shown(node.path), "its sources keep changing while it is cooked, expected --force once they no longer do"
        )

    def _wrote(self, key: Path) -> Node:
        self._cooked.add(key)
        self._digests.forget(key)
        node = self.graph.nodes[key] = read_node(self.graph.nodes[key].path)  # it may stand on other layers now
        self._grown |= not self.graph.holds(node)
        return node


def _report(node: Node, action: Action, why: tuple[str, ...] = (), warnings: tuple[str, ...] = ()) -> NodeReport:
    verb = node.recipe.verb if node.recipe else ""
    return NodeReport(file=node.path, verb=verb, action=action, why=why, warnings=warnings)
