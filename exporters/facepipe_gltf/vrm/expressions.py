"""VRM's expressions: presets that the face has, or made of its ARKit shapes by a table; every shape by its name."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from facepipe.rig.conventions import ARKIT_SHAPES, match_shapes

Json = dict[str, Any]

_TABLE = Path(__file__).with_name("expressions.toml")
_STRAIGHT = [[0.0, 0.0], [1.0, 1.0]]


@cache
def table() -> Mapping[str, Any]:
    """The table: ``preset``, name -> ARKit shape -> weight, and ``degrees``, kind -> direction -> angle."""
    read = tomllib.loads(_TABLE.read_text(encoding="utf-8"))
    for name, weights in read["preset"].items():
        read["preset"][name] = {one: weight for shape, weight in weights.items() for one in _sides(shape)}
    return read


def _sides(shape: str) -> tuple[str, ...]:
    return (shape,) if shape in ARKIT_SHAPES else (f"{shape}Left", f"{shape}Right")


@dataclass(frozen=True)
class Target:
    """A morph target of a node, and how far it is on over the weight of its shape."""

    node: int
    index: int
    shape: str
    knots: Sequence[Sequence[float]]  # piecewise linear

    def bind(self, weight: float) -> Json | None:
        """A morphTargetBind at a weight of the shape; None where the target is off."""
        at, on = np.array(self.knots, np.float64).T
        value = round(float(np.interp(weight, at, on)), 6)
        return {"node": self.node, "index": self.index, "weight": value} if value else None


@dataclass(frozen=True)
class Expressions:
    """`VRMC_vrm.expressions`, and what of the table or of the face is not in it."""

    json: Json
    lost: tuple[str, ...]

    def has(self, *presets: str) -> bool:
        """Whether each of these presets moves something."""
        return all(self.json["preset"].get(name, {}).get("morphTargetBinds") for name in presets)


def expressions_of(nodes: Sequence[Json], meshes: Sequence[Json]) -> Expressions:
    """The expressions of the morph targets that the meshes of a document name in their extras."""
    targets: dict[str, list[Target]] = {}
    for target in _targets(nodes, meshes):
        targets.setdefault(target.shape, []).append(target)
    presets = table()["preset"]
    own, arkit = match_shapes(presets, [*targets]), match_shapes(sorted(ARKIT_SHAPES), [*targets])
    preset: Json = {}
    lost: list[str] = []
    for name, weights in presets.items():
        sculpted = own.get(name, ())
        made = {} if sculpted else {one: weight for shape, weight in weights.items() for one in arkit.get(shape, ())}
        if sculpted or made or not weights:
            preset[name] = _expression(dict.fromkeys(sculpted, 1.0) | made, targets)
        lacking = [] if sculpted else [shape for shape in weights if shape not in arkit]
        if made and lacking:
            lost.append(f"part of the expression {name} (no shape {', '.join(lacking)})")
    absent = [name for name in presets if name not in preset]
    if absent:
        lost.append(f"the expressions {', '.join(absent)} (no shape of the face is part of them)")
    custom = {shape: _expression({shape: 1.0}, targets) for shape in targets if shape not in presets}
    curved = [shape for shape, every in targets.items() if any(len(one.knots) > 2 for one in every)]
    if curved:
        some = ", ".join(curved[:3]) + (" ..." if len(curved) > 3 else "")
        lost.append(f"the way over inbetweens ({len(curved)} shapes: {some}): VRM's expressions move straight")
    return Expressions({"preset": preset} | ({"custom": custom} if custom else {}), tuple(lost))


def _targets(nodes: Sequence[Json], meshes: Sequence[Json]) -> Iterator[Target]:
    for i, node in enumerate(nodes):
        extras = meshes[node["mesh"]].get("extras", {}) if "mesh" in node else {}
        own = extras.get("facepipe", {})
        for index, name in enumerate(extras.get("targetNames", [])):
            shape = own.get("inbetweens", {}).get(name, {}).get("shape", name)
            yield Target(i, index, shape, own.get("curves", {}).get(name, _STRAIGHT))


def _expression(weights: Mapping[str, float], targets: Mapping[str, Sequence[Target]]) -> Json:
    binds = [one.bind(weight) for shape, weight in weights.items() for one in targets[shape]]
    found = sorted((one for one in binds if one is not None), key=lambda one: (one["node"], one["index"]))
    return {"morphTargetBinds": found} if found else {}
