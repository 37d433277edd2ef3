"""Cards of hair."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from grids import Grids, Skin
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree
from skin_maps import Template, above_hairline, step

Array = Any
DS = 0.35  # cm a step along a hair


@dataclass(frozen=True, kw_only=True)
class Style:
    """How hair is combed. Lengths in cm."""

    direction: Callable[[Array], Array]  # of places (n, 3), any length
    length: Callable[[Array], Array]  # at roots
    height: Callable[[Array], Array]  # above the skin, at roots
    spacing: tuple[float, ...]  # between the roots of each layer, from the skin outwards
    width: float
    rows: int
    falls: bool = False  # down from the head; else it lies on it to its end
    end: float | None = None  # height at which it is cut, instead of the length
    wave: float = 0.0
    spread: float = 0.15  # how far cards turn from the combed way
    edge: float = 0.0  # how far above the hairline roots begin


WHORL = np.array([0.8, 13.8, -3.8])


def crop_direction(at: Array) -> Array:
    """Away from the whorl."""
    away = at - WHORL
    return away / np.linalg.norm(away, axis=1, keepdims=True) + [0, 0, 0.25]


def parted_direction(at: Array) -> Array:
    """Away from a parting on the left, swept back from the forehead."""
    side = np.where(at[:, :1] > 3.1, 1.0, -1.0)
    low = step(11.5, 8.0, at[:, 1])[:, None]
    behind = step(0.0, -5.0, at[:, 2])[:, None]
    top = np.column_stack([side, 0 * side, -0.55 + 0 * side])
    down = np.column_stack([0.15 * side, -1 + 0 * side, -0.45 + 0 * side])
    return top * (1 - low) * (1 - behind) + down * np.maximum(low, behind) + crop_direction(at) * 0.15


def bob_direction(at: Array) -> Array:
    """Down on both sides of a parting in the middle."""
    side = np.where(at[:, :1] > 0.25, 1.0, -1.0)
    behind, front = step(1.0, -5.0, at[:, 2])[:, None], step(4.0, 8.0, at[:, 2])[:, None]
    low, hanging = step(12.5, 7.0, at[:, 1])[:, None], step(6.5, 2.5, at[:, 1])[:, None]
    back = -0.2 - 0.45 * behind - 0.45 * front
    return np.concatenate(
        [side * (1 - 0.6 * behind) * (1 - 0.95 * low), -0.3 - low, back * (1 - 0.85 * hanging)], axis=1
    )


def outward(at: Array, normals: Array) -> Array:
    """(n, 3) the skin's normals, and away from the neck's axis below."""
    radial = at * [1, 0, 1] + [0, 0, 1.5]
    radial /= np.linalg.norm(radial, axis=1, keepdims=True)
    return normals + step(5.0, 2.0, at[:, 1])[:, None] * (radial - normals)


def over_ears(at: Array) -> Array:
    """(n,) how far from the middle hair must be to pass over the ears."""
    away = (np.column_stack([at[:, 1] - 0.8, at[:, 2] + 0.1]) / (3.6, 3.0)) ** 2
    return 9.9 * np.exp(-(away.sum(axis=1) ** 2))


def tall(at: Array) -> Array:
    """(n,) 1 on top of the head, 0 at its sides and back."""
    return step(7.5, 12.5, at[:, 1]) * step(-8.0, -2.0, at[:, 2])


STYLES = {
    "crop": Style(
        direction=crop_direction, length=lambda at: 1.7 + 1.8 * tall(at), height=lambda at: 0.3 + 0.8 * tall(at),
        spacing=(0.9, 0.95, 1.25), width=1.2, rows=4, spread=0.32, edge=0.1,
    ),
    "parted": Style(
        direction=parted_direction, length=lambda at: 2.6 + 5.4 * tall(at), height=lambda at: 0.4 + 1.6 * tall(at),
        spacing=(0.95, 1.0, 1.4), width=1.25, rows=6, spread=0.16, edge=0.1,
    ),
    "bob": Style(
        direction=bob_direction, length=lambda at: 34 + 0 * at[:, 1],
        height=lambda at: 0.9 + 0.5 * tall(at), spacing=(1.05, 1.1, 1.6), width=2.0, rows=9, falls=True, end=-7.5,
        wave=0.12, spread=0.05,         edge=0.1,
    ),
    "long": Style(
        direction=bob_direction, length=lambda at: 40 + 0 * at[:, 1],
        height=lambda at: 1.0 + 0.5 * tall(at), spacing=(1.05, 1.1, 1.5), width=2.0, rows=10, falls=True, end=-11.8,
        wave=0.3, spread=0.045, edge=0.1,
    ),
}  # fmt: skip


def roots(template: Template, allowed: Array, spacing: float, rng: Any) -> Array:
    """Places on the triangles of allowed points (n,), at least `spacing` apart."""
    triangles = template.triangles[allowed[template.triangles].all(axis=1)]
    a, b, c = (template.points[triangles[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    chosen = rng.choice(len(triangles), 30_000, p=area / area.sum())
    u, v = rng.random((2, len(chosen), 1))
    over = u + v > 1
    u, v = np.where(over, 1 - u, u), np.where(over, 1 - v, v)
    places = a[chosen] + u * (b - a)[chosen] + v * (c - a)[chosen]
    kept = np.ones(len(places), bool)
    for one, near in enumerate(cKDTree(places).query_ball_point(places, spacing)):
        if kept[one]:
            kept[[other for other in near if other > one]] = False
    return places[kept]


def combed(skin: Skin, style: Style, root: Array, layer: float, rng: Any) -> tuple[Array, Array]:
    """Middle lines (n, rows, 3) of cards from their roots, and the directions (n, rows, 3) across them."""
    count = len(root)
    length = style.length(root) * rng.uniform(0.8, 1.1, count)
    reach = style.height(root) * (0.35 + 0.65 * layer) * rng.uniform(0.8, 1.15, count)
    reach *= 0.3 + 0.7 * step(0.0, 2.5, above_hairline(root))
    turn = rng.normal(0, style.spread, (count, 3))
    at, line, across = root.copy(), [], []
    for number in range(int(np.ceil(length.max() / DS)) + 2):
        height, normal = skin.under(at)
        way = style.direction(at)
        way = way / np.linalg.norm(way, axis=1, keepdims=True) + turn
        if style.falls:
            normal = outward(at, normal)
        way -= step(4.0, 1.5, height)[:, None] * (way * normal).sum(axis=1, keepdims=True) * normal
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        side = np.cross(way, normal) + 0.25 * turn
        line.append(at)
        across.append(side / np.linalg.norm(side, axis=1, keepdims=True))
        at = at + DS * way
        height, normal = skin.under(at)
        if style.falls:
            normal = outward(at, normal)
        risen = np.interp(
            number * DS / np.minimum(length, 9.0), [0, 0.12, 0.45, 1], [0.05, 0.55, 1.0, 0.8 + 0.2 * style.falls]
        )
        lift = reach * risen - height
        if style.falls:  # off the head it hangs freely
            lift = np.maximum(lift, 0.3 * lift * step(0.0, 0.5, normal[:, 1]))
        at = at + lift[:, None] * normal
        if style.falls:
            at[:, 0] = np.copysign(np.maximum(np.abs(at[:, 0]), over_ears(at)), at[:, 0])
    line = gaussian_filter1d(np.array(line), 1.5, axis=0, mode="nearest")
    across = gaussian_filter1d(np.array(across), 1.5, axis=0, mode="nearest")
    if style.end is not None:
        end = style.end + rng.normal(0, 0.35, count) + 1.2 * layer * rng.random(count)
        length = np.maximum((line[..., 1] > end).sum(axis=0) * DS, 2.0)
    at = np.linspace(0, 1, style.rows)[:, None] ** (1.6 if style.falls else 1.0) * np.minimum(
        length / DS, len(line) - 1.01
    )
    low, share = at.astype(int), (at % 1)[..., None]
    each = np.arange(count)
    line, across = (one[low, each] * (1 - share) + one[low + 1, each] * share for one in (line, across))
    bend = style.wave * np.sin(0.75 * DS * at + rng.uniform(0, 6.3, count)) * np.minimum(DS * at / 9, 1)
    return np.moveaxis(line + bend[..., None] * across, 0, 1), np.moveaxis(across, 0, 1)


def hair_grids(template: Template, skin: Skin, style: Style, scalp: Array) -> Grids:
    """Layers of cards: dense ones on the skin, then locks, then thin ones."""
    rng = np.random.default_rng(21)
    points, uvs = [], []
    above = above_hairline(template.points)
    for number, spacing in enumerate(style.spacing):
        layer = number / (len(style.spacing) - 1)
        root = roots(template, (scalp > 0.5) & (above > style.edge + 0.25 * number), spacing, rng)
        line, across = combed(skin, style, root, layer, rng)
        half = np.interp(np.arange(style.rows) / style.rows, [0, 0.15], [0.75 if style.falls else 0.6, 1])[:, None]
        half = (
            half
            * np.where(above_hairline(root) < 0.7, 0.6, 1)[:, None, None]
            * 0.5
            * style.width
            * rng.uniform(0.75, 1.2, (len(root), 1, 1))
            * (1.15 - 0.3 * layer)
        )
        points.append(np.stack([line - half * across, line + half * across], axis=2))
        column = (number + (rng.random(len(root)) < 0.25) + (number == 2)).clip(0, 3)
        column[above_hairline(root) < 0.7] = 1 if style.falls else 2  # a soft edge
        u = (column[:, None] + np.where(rng.random(len(root))[:, None] < 0.5, [0.03, 0.97], [0.97, 0.03])) / 4
        v = 0.005 + 0.99 * np.linspace(0, 1, style.rows) ** (1.6 if style.falls else 1.0)
        uvs.append(np.stack(np.broadcast_arrays(u[:, None, :], v[None, :, None]), axis=-1))
    points = np.concatenate(points)
    held = np.broadcast_to(points.mean(axis=2, keepdims=True), points.shape)
    return Grids(points, np.concatenate(uvs), held)


def coil_grids(template: Template, skin: Skin, scalp: Array) -> Grids:
    """Patches of curls, three deep, that lie roughly along the head."""
    rng = np.random.default_rng(22)
    points, uvs, held = [], [], []
    for number, height in enumerate((0.35, 0.9, 1.5, 2.0)):
        root = roots(template, scalp > 0.6 + 0.1 * number, 0.7 + 0.07 * number, rng)
        normal = skin.under(root)[1]
        axis = rng.normal(0, 1, (len(root), 3)) + 1e-3
        normal = normal + rng.normal(0, 0.28 + 0.1 * number, normal.shape)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        first = np.cross(normal, axis)
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        second = np.cross(normal, first)
        middle = root + (height * rng.uniform(0.75, 1.15, len(root)))[:, None] * normal
        half = rng.uniform(0.9, 1.25, (len(root), 1))
        square = [[middle - half * first - half * second, middle + half * first - half * second],
                  [middle - half * first + half * second, middle + half * first + half * second]]  # fmt: skip
        points.append(np.moveaxis(np.array(square), 2, 0))
        patch = rng.integers(0, 2, len(root)) + 2 * (number == 3)
        corner = np.stack([patch % 2, 1 - patch // 2], axis=-1)[:, None, None, :]
        grid = np.stack(np.meshgrid([0.02, 0.98], [0.02, 0.98]), axis=-1)
        uvs.append((corner + grid) / 2)
        held.append(np.broadcast_to(root[:, None, None], points[-1].shape))
    return Grids(*(np.concatenate(one) for one in (points, uvs, held)))
