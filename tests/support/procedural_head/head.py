"""The head's points: the grid on the featured skull, then the patches of mouth, nostrils, eyes and ears."""

from __future__ import annotations

from functools import cache

import numpy as np

from facepipe.core.arrays import FloatArray
from procedural_head import ears, eyes, features, mouth, topology
from procedural_head.identity import Identity
from procedural_head.skull import Skull, build

_STEPS = np.concatenate([np.full(8, 1.4), np.full(11, 2.0), [2.6, 3.4, 4.2, 5.0, 5.8]])


@cache
def column_angles() -> FloatArray:
    """(COLUMNS,) polar angle of every column; dense in the face."""
    behind = topology.COLUMNS // 2 - len(_STEPS)
    steps = np.concatenate([_STEPS, np.full(behind, (180.0 - _STEPS.sum()) / behind)])
    half = np.radians(np.concatenate([[0.0], np.cumsum(steps)]))
    return np.concatenate([half, -half[-2:0:-1]])


def points(who: Identity) -> FloatArray:
    """(n, 3) points of the head, exactly symmetric in x."""
    layout = topology.build()
    skull = build(who)
    result = np.zeros((layout.point_count, 3))
    angle, level = np.meshgrid(column_angles(), topology.row_levels())
    known = layout.grid >= 0
    result[layout.grid[known]] = features.displace(skull.surface(angle[known], level[known]), who)
    result[layout.cap] = _cap(skull)
    rings = layout.rings
    result[rings["nostrilLeft"]] = _nostril(result[rings["nostrilLeft"][0]])
    result[rings["mouth"]] = mouth.place(result[rings["mouth"][0]], skull, who)
    result[rings["eyeLeft"]] = eyes.place_lids(result[rings["eyeLeft"][0]], eyes.eye(who))
    root = ears.root(_coordinates("earLeft"))
    root_points = features.displace(skull.surface(root[:, 0], root[:, 1]), who)
    result[rings["earLeft"]] = ears.place(result[rings["earLeft"][0]], root_points, who)
    return _symmetric(_smoothed(result, layout), layout)


def _smoothed(result: FloatArray, layout: topology.Topology) -> FloatArray:
    """Points with the joints between grid and patches faired."""
    amount = np.zeros(layout.point_count)
    for name, depths in (
        ("eyeLeft", (0.6, 0.6, 0.4, 0.2)),
        ("mouth", (0.5, 0.5, 0.3)),
        ("earLeft", (0.0, 0.0, 0.15)),
        ("nostrilLeft", (0.4,)),
    ):
        for ring, depth in zip(layout.rings[name], depths, strict=False):
            amount[ring] = np.maximum(amount[ring], depth)
    average = layout.averaging()
    around = np.maximum(amount, 0.8 * (average @ amount))
    around[layout.rings["nostrilLeft"][1:]] = 0.0
    for _ in range(6):
        result = result + around[:, None] * (average @ result - result)
    return result


def _coordinates(patch: str) -> FloatArray:
    """(spokes, 2) angle and level of a patch's outline."""
    columns, rows = np.array(topology.BLOCKS[patch].perimeter()).T
    return np.stack([column_angles()[columns], topology.row_levels()[rows]], axis=1)


def _cap(skull: Skull) -> FloatArray:
    """(CAP + 1, CAP + 1, 3) points of the crown cap."""
    size = topology.CAP
    v, u = np.meshgrid(np.linspace(-1, 1, size + 1), np.linspace(-1, 1, size + 1), indexing="ij")
    ring = np.maximum(np.abs(u), np.abs(v))
    safe = np.maximum(ring, 1e-9)
    a, b = (u / safe + 1) * size / 2, (v / safe + 1) * size / 2
    column = np.select(
        [v <= -safe + 1e-12, u >= safe - 1e-12, v >= safe - 1e-12],
        [a - size / 2, b + size / 2, 2.5 * size - a],
        default=3.5 * size - b,
    )
    angles = np.unwrap(np.append(column_angles(), column_angles()[0]))
    angle = np.interp(column % topology.COLUMNS, np.arange(topology.COLUMNS + 1), angles)
    level = topology.row_levels()[0] * ring
    return skull.surface(angle.ravel(), level.ravel()).reshape(size + 1, size + 1, 3)


def _nostril(outline: FloatArray) -> FloatArray:
    """(4, spokes, 3) points of the left nostril's patch: a rounded rim and a hole upwards and back."""
    middle = outline.mean(axis=0)
    offset = outline - middle
    distance = np.linalg.norm(offset, axis=1, keepdims=True)
    rounded = offset * (distance.mean() / distance) ** 0.7
    inward = np.array([-0.1, 0.85, -0.5])
    inset = [(0.84, 0.0), (0.68, 0.1), (0.5, 0.45)]
    return np.concatenate([outline[None], [middle + rounded * scale + depth * inward for scale, depth in inset]])


def _symmetric(result: FloatArray, layout: topology.Topology) -> FloatArray:
    for name, ring in layout.rings.items():
        if name.endswith("Left"):
            result[layout.mirror[ring]] = result[ring] * (-1, 1, 1)
    mirrored = result[layout.mirror] * (-1, 1, 1)
    return np.asarray((result + mirrored) / 2)
