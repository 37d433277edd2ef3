"""Recipes evaluated again where their sources have changed, in the order in which files depend on each other."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from facepipe.actions import cookable
from facepipe.cooking.graph import Digests, Graph, Node, changes, read_graph, read_node, shown, waiting
from facepipe.cooking.report import Action, CookOptions, CookReport, NodeReport
from facepipe.core.atomic import collect
from facepipe.core.errors import FacepipeError, InputError
from facepipe.core.locks import discard_lock, locked
from facepipe.core.policy.paths import trust, trusting
from facepipe.core.reports import Report
from facepipe.kinds import Watch, unwatched
from facepipe.performing import again

AnyPath = str | os.PathLike[str]

_TRIES = 3  # of a file whose sources change while it is made


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
        reasons = changes(self.graph, node, self._digests, self._cooked)
        reasons += waiting(self.graph, node, self._stale)
        forced = self._options.force and node.path.resolve() not in self._cooked
        return reasons or (("forced",) if forced else ())

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
