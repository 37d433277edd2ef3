"""Damage to FBX files: to their bytes, their text, and what their nodes hold."""

from __future__ import annotations

import copy
import random
from pathlib import Path
from typing import Any

import fbx_files
import fuzz_damage as damage
import numpy as np
from fbx_files import Node
from fuzzing import Line

_NUMBERS = [0, 1, -1, 2, 3, 7, 100, 255, 65536, 2**31 - 1, -(2**31)]
_REALS = [0.0, -0.0, 1.0, -1.0, 100.0, 1e-30, 1e9, 1e17, 1e30, -1e300, 1e308, np.nan, np.inf, -np.inf]
_LINES = [
    ["import", "fbx", "face.fbx", "out.usda"],
    ["inspect", "face.fbx"],
    ["export", "face.fbx", "-o", "out.glb", "--animations"],
]


def put_binary(*, deflate: bool = True, version: int = 7400) -> None:
    """The full scene; without deflation damage of bytes comes to its numbers."""
    Path("face.fbx").write_bytes(fbx_files.full_scene().binary(deflate=deflate, version=version))


def put_ascii() -> None:
    Path("face.fbx").write_bytes(fbx_files.full_scene().ascii())


def damage_fbx(rng: random.Random, part: str) -> list[Line]:
    path = Path("face.fbx")
    if part.startswith("nodes"):
        nodes = fbx_files.full_scene().nodes()
        for _ in range(damage.some(rng)):
            _change(rng, nodes)
        path.write_bytes(fbx_files.ascii_text(nodes) if rng.random() < 0.2 else fbx_files.binary(nodes))
    elif part == "ascii":
        path.write_bytes(damage.damaged_text(rng, path.read_bytes()))
    else:
        path.write_bytes(damage.damaged_bytes(rng, path.read_bytes()))
    return [rng.choice(_LINES)]


def _change(rng: random.Random, nodes: list[Node]) -> None:
    """One node gone, again, elsewhere, or with another value."""
    every: list[tuple[list[Node], int]] = []

    def walk(listed: list[Node]) -> None:
        for place, one in enumerate(listed):
            every.append((listed, place))
            walk(one.children)

    walk(nodes)
    listed, place = rng.choice(every[1:])
    one, way = listed[place], rng.random()
    if way < 0.1:
        del listed[place]
    elif way < 0.2:
        listed.insert(rng.randrange(len(listed) + 1), copy.deepcopy(one))
    elif way < 0.3:
        other, at = rng.choice(every)
        if other[at : at + 1] and not any(inner is listed for inner, _ in every if inner is other[at].children):
            listed[place] = copy.deepcopy(other[at])
    elif one.values:
        at = rng.randrange(len(one.values))
        values = list(one.values)
        values[at] = _other(rng, values[at], every)
        one.values = tuple(values)


def _other(rng: random.Random, value: Any, every: list[tuple[list[Node], int]]) -> Any:
    if isinstance(value, np.ndarray):
        return _array(rng, value)
    if isinstance(value, np.int64):  # numbers of objects: cycles, and links to what is of another kind
        known = [
            one.values[0] for listed, at in every if (one := listed[at]).values and isinstance(one.values[0], np.int64)
        ]
        return rng.choice([*known, np.int64(rng.choice([0, -1, 2**62]))])
    if isinstance(value, int):
        return rng.choice(_NUMBERS)
    if isinstance(value, float):
        return float(rng.choice(_REALS))
    texts = [one for listed, at in every for one in listed[at].values if isinstance(one, str)]
    if isinstance(value, str):
        return rng.choice([*rng.sample(texts, 8), *(one for one in damage.NAMES if one.isprintable())])
    return damage.damaged_bytes(rng, value)


def _array(rng: random.Random, value: np.ndarray) -> np.ndarray:
    way, changed = rng.random(), value.copy()
    if way < 0.2:
        return changed[: rng.randrange(len(changed) + 1)]
    if way < 0.3:
        return np.resize(changed, rng.choice([len(changed) * 2, len(changed) + 1, 3000]))
    for _ in range(damage.some(rng)):
        if len(changed):
            pool = _REALS if changed.dtype.kind == "f" else _NUMBERS
            with np.errstate(over="ignore"):
                changed[rng.randrange(len(changed))] = np.array(rng.choice(pool)).astype(changed.dtype)
    return changed
