"""What a stage composes to and holds, counted before USD composes, follows or reads it.

A few lines of references that double on every level make more prims than memory holds. The count is an upper bound: it
takes all variants and payloads, and instances in full.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pxr import Ar, Pcp, Sdf, Usd, UsdSkel

from facepipe.core.errors import InputError
from facepipe.core.policy.bounds import Budget, same_file
from facepipe.stage.layer_files import MOST_LEVELS, LayerTable, file_of, open_layer
from facepipe.stage.values import UNREADABLE, USD_ERRORS

MOST_SCHEMAS = 1250  # on a prim, and the root of the squares of all lists of them: USD takes up to 3 us for each square
MOST_STEPS = 1000  # properties that lead on, from one to all that it leads to, each as often as USD comes there
_FEW_SCHEMAS = 10
_EVERYTHING = Usd.TraverseInstanceProxies(Usd.PrimAllPrimsPredicate)
_FREE_BYTES, _PER_BYTE = 1 << 23, 8  # of the arrays of a face together: these, and as many for each byte of its layers
_KINDS_COUNTED = ("Mesh", "BlendShape", "SkelAnimation", "Skeleton", "GeomSubset", "SkelRoot")
_SCALAR_BYTES = {"bool": 1, "half": 2, "int": 4, "uint": 4, "float": 4, "string": 8, "token": 8, "quatf": 16}  # bytes
_DEFAULT = Usd.TimeCode.Default()
MOST_COMPOSED = 250_000  # opinions that arcs add, beyond two a written prim; each costs USD some 10 us and 1 kB
MOST_LAYERS = 4096  # of a stage
MOST_SUBLAYERS = 500  # of a layer, those below them included, as often as they come
_ROOT = Sdf.Path.absoluteRootPath


def check_counts(where: object, stage: Usd.Stage) -> None:
    """Look through a stage without composing what its prims are.

    :raises InputError: too many API schemas, joints too deep, or properties that lead through too many others or back
        to themselves
    """
    root = stage.GetPseudoRoot()
    lists: set[tuple[str, ...]] = set()
    squares = 0
    for prim in Usd.PrimRange(root, _EVERYTHING):
        applied = tuple(prim.GetPrimTypeInfo().GetAppliedAPISchemas())
        if len(applied) > _FEW_SCHEMAS and applied not in lists:
            lists.add(applied)
            squares += len(applied) ** 2
            if squares > MOST_SCHEMAS**2:
                found = f"{len(applied)} API schemas here and {sum(map(len, lists)) - len(applied)} on other prims"
                raise InputError(f"{where} -> {prim.GetPath()}", f"{found}, expected at most {MOST_SCHEMAS}")
    steps: dict[Sdf.Path, int] = {}
    for prim in Usd.PrimRange(root, _EVERYTHING):
        # prim by prim: USD's search for all connections at once starts threads that cost 0.05 s
        for attribute in prim.GetAuthoredAttributes():
            for path in attribute.GetConnections() if attribute.HasAuthoredConnections() else ():
                if path.IsPropertyPath():
                    _check_steps(where, stage, path, steps)
        if prim.IsA(UsdSkel.Skeleton):
            try:
                joints = UsdSkel.Skeleton(prim).GetJointsAttr().Get() or ()
                deepest = max((str(joint).count("/") for joint in joints), default=0)
            except UNREADABLE:
                deepest = 0  # its reader reports that
            if deepest >= MOST_LEVELS:
                raise InputError(f"{where} -> {prim.GetPath()}.joints", f"nests joints more than {MOST_LEVELS} deep")
        for relationship in prim.GetAuthoredRelationships():
            _check_steps(where, stage, relationship.GetPath(), steps)


def _check_steps(where: object, stage: Usd.Stage, start: Sdf.Path, steps: dict[Sdf.Path, int]) -> None:
    """Follow a property as USD does, which goes several ways to one and the same several times.

    :param steps: of the properties that were followed; filled in
    """
    # a list instead of recursion, which a long chain of connections would end at Python's limit
    todo, begun = [start], set()
    while todo:
        path = todo[-1]
        if path in steps:
            todo.pop()
        elif path not in begun:
            begun.add(path)
            onward = _onward(stage, path)
            if any(following in begun and following not in steps for following in onward):
                raise InputError(f"{where} -> {path}", "leads back to itself, expected an end")
            todo.extend(onward)
        else:
            onward = _onward(stage, path)
            steps[path] = 1 + sum(steps[following] for following in onward) if onward else 0
            if steps[path] > MOST_STEPS:
                raise InputError(f"{where} -> {path}", f"leads through more than {MOST_STEPS} properties")


def _onward(stage: Usd.Stage, path: Sdf.Path) -> list[Sdf.Path]:
    found = stage.GetPropertyAtPath(path)
    paths = found.GetConnections() if isinstance(found, Usd.Attribute) else found.GetTargets() if found else []
    return [target for target in paths if target.IsPropertyPath()]


def check_arrays(prims: Sequence[Usd.Prim], where: object) -> None:
    """:raises InputError: arrays far beyond what the files of the stage hold; one that is made in memory has any"""
    stage = prims[0].GetStage() if prims else None
    layers = [] if stage is None else [layer for layer in stage.GetUsedLayers() if layer != stage.GetSessionLayer()]
    if any(layer.anonymous for layer in layers):
        return
    budget = Budget(_FREE_BYTES, _PER_BYTE)
    for layer in layers:
        file = file_of(layer.realPath)
        if file.is_file():
            budget.grant(os.stat(file).st_size, same_file(file))  # noqa: PTH116
    for prim in prims:
        arrays = prim.GetAuthoredAttributes() if prim.GetTypeName() in _KINDS_COUNTED else ()
        for attribute in arrays:
            kind, times = attribute.GetTypeName(), attribute.GetNumTimeSamples()
            try:
                value = attribute.Get(Usd.TimeCode.EarliestTime() if times else _DEFAULT) if kind.isArray else None
            except UNREADABLE:
                continue  # its reader reports that
            if value is not None and hasattr(value, "__len__"):
                scalar = kind.scalarType
                each = _SCALAR_BYTES.get(str(scalar), np.asarray(scalar.defaultValue).nbytes)
                # all samples of an animation are read, of other prims one
                samples = max(times, 1) if prim.IsA(UsdSkel.Animation) else 1
                budget.spend(samples * len(value) * each, lambda what: InputError(where, what))


class _Count(NamedTuple):
    """The counts of a prim and what is below it."""

    prims: int
    opinions: int  # of all prims together
    most: int  # of one prim
    levels: int  # of prims and arcs, one in another


class _Stack:
    """A layer with its sublayers, strongest first."""

    def __init__(self, tables: tuple[LayerTable, ...], variables: dict[str, Any]) -> None:
        self.tables = tables
        self.variables = variables

    @cached_property
    def with_arcs(self) -> tuple[LayerTable, ...]:
        return tuple(table for table in self.tables if table.arcs)

    def size(self, path: Sdf.Path) -> int:
        return sum(table.sizes.get(path, 0) for table in self.tables)

    def children_with_arcs(self, path: Sdf.Path) -> set[Sdf.Path]:
        return {child for table in self.with_arcs for child in table.children_with_arcs.get(path, ())}


def checked_layers(path: Path) -> list[Sdf.Layer]:
    """The layers that a file stands on, each looked at before USD opens it; USD keeps them open while they are held.

    :raises InputError: too many, sublayers too deep, or one of no regular file or that promises too much
    """
    return [table.layer for table in Composition(path).tables.values()]


def composable_layers(path: Path) -> list[Sdf.Layer]:
    """The layers as `checked_layers` gives them, where USD can compose them.

    :raises InputError: as above; arcs that come to too many opinions, too deep or in a circle
    """
    stage = Composition(path)
    total = stage.count()
    if total is not None:
        most = MOST_COMPOSED + 2 * sum(table.sizes[_ROOT] for table in stage.tables.values())
        if total.opinions > most:
            raise stage.too_much(f"{total.opinions}" if total.opinions < 10**12 else "more than 10^12", most)
        if any(table.has_classes for table in stage.tables.values()):
            stage.compose(most)
    return [table.layer for table in stage.tables.values()]


class Composition:
    """The layers of a file, and what their arcs come to."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.tables: dict[str, LayerTable] = {}
        self._stacks: dict[tuple[str, str], _Stack | None] = {}
        self._targets: dict[tuple[int, str, str], _Stack | None] = {}
        self._counts: dict[tuple[int, Sdf.Path, bool], _Count | None] = {}
        self._steps = 0
        self._context = Ar.GetResolver().CreateDefaultContextForAsset(str(path))
        with Ar.ResolverContextBinder(self._context):
            self.root = self._stack(str(path), {})
            todo, seen = [self.root], set()
            while todo:
                stack = todo.pop()
                if stack is None or id(stack) in seen:
                    continue
                seen.add(id(stack))
                for table in stack.with_arcs:
                    assets = {arc.asset for arcs in table.arcs.values() for arc in arcs if arc.asset}
                    todo.extend(self._target(stack, table, asset) for asset in sorted(assets))

    def count(self) -> _Count | None:
        """What arcs make of the stage; None where it has none."""
        if self.root is None or not any(stack.with_arcs for stack in self._stacks.values() if stack):
            return None
        with Ar.ResolverContextBinder(self._context):
            return self._below(self.root, _ROOT, 0)

    def compose(self, most: int) -> None:
        """Index prim after prim: what a class gets in the layers that refer to it is not counted elsewhere.

        :raises InputError: more than `most` opinions
        """
        if self.root is None:
            return
        cache = Pcp.Cache(Pcp.LayerStackIdentifier(self.root.tables[0].layer, None, self._context), "usd", True)
        todo, composed = [_ROOT], 0
        while todo:
            path = todo.pop()
            index, _ = cache.ComputePrimIndex(path)
            # Pcp leaves payloads out until they are asked for, while the stage will be opened with all of them
            if index.hasAnyPayloads:
                cache.RequestPayloads([path], [])
                index, _ = cache.ComputePrimIndex(path)
            nodes, below = 0, [index.rootNode]
            while below:
                nodes += 1
                below.extend(below.pop().children)
            composed += nodes
            if composed > most:
                raise self.too_much(f"more than {most}", most)
            if nodes > 1 or self.root.children_with_arcs(path) or path == _ROOT:
                todo.extend(path.AppendChild(name) for name in index.ComputePrimChildNames()[0])

    # what is below a prim

    def _below(self, stack: _Stack, path: Sdf.Path, level: int) -> _Count:
        """The count of the prims that the layers have at and below a path, and of what the arcs on them add."""
        key = (id(stack), path, False)
        if key in self._counts:
            return self._known(key)
        self._step(len(stack.tables), level)
        self._counts[key] = None
        ways = stack.children_with_arcs(path)
        own = [self._below(stack, way, level + 1) for way in ways]
        plain = max(stack.size(path) - sum(stack.size(way) for way in ways), 1)
        base = _Count(
            plain + sum(child.prims for child in own),
            plain + sum(child.opinions for child in own),
            max((child.most for child in own), default=1),
            1 + max((child.levels for child in own), default=0),
        )
        parts = [self._whole(target, prim, level + 1) for target, prim in self._targets_at(stack, path)]
        return self._keep(key, _joined(base, parts))

    def _whole(self, stack: _Stack, path: Sdf.Path, level: int) -> _Count:
        """The count of `_below` with what the arcs of the prims above add."""
        key = (id(stack), path, True)
        if key in self._counts:
            return self._known(key)
        self._step(len(stack.tables), level)
        self._counts[key] = None
        base = self._below(stack, path, level + 1)
        parts = [
            self._whole(target, path.ReplacePrefix(above, prim), level + 1)
            for above in path.GetPrefixes()[:-1]
            for target, prim in self._targets_at(stack, above)
        ]
        return self._keep(key, _joined(base, parts))

    def _step(self, layers: int, level: int) -> None:
        self._steps += layers
        if self._steps > 2 * MOST_COMPOSED:
            raise self.too_much(f"more than {MOST_COMPOSED}", MOST_COMPOSED)
        if level > MOST_LEVELS:
            raise InputError(self.path, f"nests prims and references more than {MOST_LEVELS} deep")

    def _known(self, key: tuple[int, Sdf.Path, bool]) -> _Count:
        count = self._counts[key]
        if count is None:
            raise InputError(self.path, f"composition error: Cycle of references at <{key[1]}>")
        return count

    def _keep(self, key: tuple[int, Sdf.Path, bool], count: _Count) -> _Count:
        if count.levels > MOST_LEVELS:
            raise InputError(self.path, f"nests prims and references more than {MOST_LEVELS} deep")
        self._counts[key] = count
        return count

    def too_much(self, found: str, most: int) -> InputError:
        return InputError(self.path, f"composes to {found} opinions by its references, expected at most {most}")

    def _targets_at(self, stack: _Stack, path: Sdf.Path) -> list[tuple[_Stack, Sdf.Path]]:
        """Where the arcs on a prim lead; an arc that several layers have is one."""
        targets = {}
        for table in stack.with_arcs:
            for arc in table.arcs.get(path, ()):
                target = self._target(stack, table, arc.asset)
                if target is not None:
                    prim = arc.prim or target.tables[0].layer.GetDefaultPrimAsPath()
                    if not prim.isEmpty:
                        targets[id(target), prim, arc.offset] = (target, prim)
        return list(targets.values())

    # layers

    def _target(self, stack: _Stack, table: LayerTable, asset: str) -> _Stack | None:
        """The layers that an arc leads to."""
        if not asset:
            return stack
        key = (id(stack), table.layer.identifier, asset)
        if key not in self._targets:
            identifier = _identifier(table.layer, asset, stack.variables)
            self._targets[key] = self._stack(identifier, stack.variables) if identifier else None
        return self._targets[key]

    def _stack(self, identifier: str, variables: dict[str, Any]) -> _Stack | None:
        """The layers below an identifier; `variables` of what refers to it are stronger than its own."""
        key = (identifier, repr(sorted(variables.items())))
        if key not in self._stacks:
            if len(self._stacks) >= MOST_LAYERS:
                raise InputError(self.path, f"refers to more than {MOST_LAYERS} layers")
            root = self._table(identifier)
            if root is None:
                self._stacks[key] = None
            else:
                variables = {**root.layer.expressionVariables, **variables}
                tables = []
                todo: list[tuple[LayerTable, tuple[str, ...]]] = [(root, (root.layer.identifier,))]
                while todo:
                    table, trail = todo.pop()
                    tables.append(table)
                    if len(tables) > MOST_SUBLAYERS or len(trail) > MOST_LEVELS:
                        most = f"{MOST_SUBLAYERS} sublayers or {MOST_LEVELS} levels of them"
                        raise InputError(self.path, f"a layer has more than {most}")
                    for name in reversed(table.layer.subLayerPaths):
                        named = _identifier(table.layer, name, variables)
                        below = self._table(named) if named else None
                        if below is not None and below.layer.identifier not in trail:  # USD passes over a circle
                            todo.append((below, (*trail, below.layer.identifier)))
                self._stacks[key] = _Stack(tuple(tables), variables)
        return self._stacks[key]

    def _table(self, identifier: str) -> LayerTable | None:
        try:
            layer = open_layer(identifier)
        except (*USD_ERRORS, RuntimeError, OSError):
            return None  # USD reports it as it composes
        if layer is None:
            return None
        if layer.identifier not in self.tables:
            if len(self.tables) >= MOST_LAYERS:
                raise InputError(self.path, f"refers to more than {MOST_LAYERS} layers")
            self.tables[layer.identifier] = LayerTable(layer)
        return self.tables[layer.identifier]


def _identifier(layer: Sdf.Layer, asset: str, variables: dict[str, Any]) -> str:
    """The identifier that an asset path of a layer stands for; empty where that is none."""
    if Sdf.VariableExpression.IsExpression(asset):
        value = Sdf.VariableExpression(asset).Evaluate(variables).value
        asset = value if isinstance(value, str) else ""
    return str(Sdf.ComputeAssetPathRelativeToLayer(layer, asset)) if asset else ""


def _joined(base: _Count, parts: Sequence[_Count]) -> _Count:
    """A prim with what its arcs add: each prim below has opinions of all of them, even where they say nothing."""
    if not parts:
        return base
    prims = base.prims + sum(part.prims - 1 for part in parts)  # what an arc leads to is the prim itself
    crossed = sum((prims - part.prims) * part.most for part in parts) + (prims - base.prims)
    return _Count(
        prims,
        base.opinions + sum(part.opinions for part in parts) + crossed,
        base.most + sum(part.most for part in parts),
        max(base.levels, 1 + max(part.levels for part in parts)),
    )
