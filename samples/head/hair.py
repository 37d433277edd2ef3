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
from strokes import LONG, SHORT, WIDE, Lock

Array = Any
DS = 0.35  # cm a step along a hair
WHORL = np.array([0.8, 13.8, -3.8])
PARTING = {"parted": 3.1, "middle": 0.6}  # cm to the left


@dataclass(frozen=True, kw_only=True)
class Layer:
    """Cards of one depth."""

    spacing: float  # cm between roots
    locks: tuple[Lock, ...]  # of the picture, that they show
    height: float  # share of the style's above the skin
    width: float = 1.0  # of the style's
    shorter: float = 0.0  # cm, at most
    above: float = -20.0  # height of the lowest roots, cm: hair from above lies over what comes from below it


@dataclass(frozen=True, kw_only=True)
class Style:
    """How hair is combed. Lengths in cm."""

    direction: Callable[[Array], Array]  # of places (n, 3), any length
    length: Callable[[Array], Array]  # at roots
    height: Callable[[Array], Array]  # above the skin, at roots
    layers: tuple[Layer, ...]  # from the skin outwards
    width: float
    rows: int
    parting: float | None = None
    falls: bool = False  # down from the head; else it lies on it to its end
    end: Callable[[Array], Array] | None = None  # height at which hair of roots (n, 3) is cut, instead of the length
    inward: float = 0.0  # how much ends turn in
    wave: float = 0.0
    spread: float = 0.15  # how far cards turn from the combed way
    gathered: float = 0.0  # share of the way to the middle of its lock that a tip goes


def crop_direction(at: Array) -> Array:
    """Away from the whorl."""
    away = at - WHORL
    return away / np.linalg.norm(away, axis=1, keepdims=True) + [0, 0, 0.25]


def parted_direction(at: Array) -> Array:
    """Away from a parting on the left, swept back from the forehead."""
    side = np.where(at[:, :1] > PARTING["parted"], 1.0, -1.0)
    low = step(11.5, 8.0, at[:, 1])[:, None]
    behind = step(0.0, -5.0, at[:, 2])[:, None]
    top = np.column_stack([side, 0 * side, -0.55 + 0 * side])
    down = np.column_stack([0.15 * side, -1 + 0 * side, -0.45 + 0 * side])
    return top * (1 - low) * (1 - behind) + down * np.maximum(low, behind) + crop_direction(at) * 0.15


def falling_direction(at: Array) -> Array:
    """Down on both sides of a parting, from shoulders forward or back."""
    side = np.where(at[:, :1] > PARTING["middle"], 1.0, -1.0)
    behind, front = step(1.0, -5.0, at[:, 2])[:, None], step(4.0, 8.0, at[:, 2])[:, None]
    low, hanging = step(12.5, 7.0, at[:, 1])[:, None], step(6.5, 2.5, at[:, 1])[:, None]
    back = (-0.2 - 0.45 * behind - 0.45 * front) * (1 - 0.85 * hanging)
    back += np.where(at[:, 2:] > -1.0, 0.7, -0.9) * step(-7.5, -11.5, at[:, 1])[:, None]
    return np.concatenate([side * (1 - 0.6 * behind) * (1 - 0.95 * low), -0.3 - low, back], axis=1)


def radial(at: Array) -> Array:
    """(n, 3) unit, level, away from the neck's axis."""
    away = at * [1, 0, 1] + [0, 0, 1.5]
    return away / np.linalg.norm(away, axis=1, keepdims=True)


def outward(at: Array, normals: Array) -> Array:
    """(n, 3) the skin's normals, but away from the neck's axis beside it."""
    beside = step(5.0, 2.0, at[:, 1]) * step(-10.5, -8.5, at[:, 1])
    return normals + beside[:, None] * (radial(at) - normals)


def over_ears(at: Array) -> Array:
    """(n,) how far from the middle hair must be to pass over the ears."""
    away = (np.column_stack([at[:, 1] - 0.8, at[:, 2] + 0.1]) / (3.6, 3.0)) ** 2
    return 9.9 * np.exp(-(away.sum(axis=1) ** 2))


def tall(at: Array) -> Array:
    """(n,) 1 on top of the head, 0 at its sides and back."""
    return step(7.5, 12.5, at[:, 1]) * step(-8.0, -2.0, at[:, 2])


def before(at: Array) -> Array:
    """(n,) 1 at the front of the head, 0 behind the ears."""
    return step(-2.0, 5.0, at[:, 2])


_LYING = (
    Layer(spacing=1.0, locks=SHORT[:2], height=0.35, width=1.15),
    Layer(spacing=1.05, locks=SHORT[1:4], height=0.7),
    Layer(spacing=1.2, locks=SHORT[2:6], height=0.95, width=0.9),
    Layer(spacing=2.3, locks=SHORT[6:], height=1.1, width=0.9),
)
_HANGING = (
    Layer(spacing=1.75, locks=LONG[:1], height=0.25),
    Layer(spacing=1.6, locks=LONG[:3], height=0.6, shorter=0.8),
    Layer(spacing=1.25, locks=LONG[1:4], height=0.85, shorter=2.0, above=8.5),
    Layer(spacing=1.6, locks=LONG[3:5], height=1.0, width=0.9, shorter=3.0, above=9.5),
    Layer(spacing=2.2, locks=LONG[5:], height=1.2, width=0.9, shorter=3.0, above=8.5),
)
STYLES = {
    "crop": Style(
        direction=crop_direction, length=lambda at: 1.7 + 1.8 * tall(at), height=lambda at: 0.3 + 0.8 * tall(at),
        layers=_LYING, width=1.2, rows=4, spread=0.32,
    ),
    "parted": Style(
        direction=parted_direction, length=lambda at: 2.6 + 5.4 * tall(at), height=lambda at: 0.4 + 1.6 * tall(at),
        layers=_LYING, width=1.25, rows=6, parting=PARTING["parted"], spread=0.14, gathered=0.35,
    ),
    "bob": Style(
        direction=falling_direction, length=lambda at: 34 + 0 * at[:, 1], height=lambda at: 1.0 + 0.5 * tall(at),
        layers=_HANGING, width=2.0, rows=11, parting=PARTING["middle"], falls=True,
        end=lambda at: -5.6 - 1.6 * before(at), inward=0.75, wave=0.12, spread=0.06, gathered=0.4,
    ),
    "long": Style(
        direction=falling_direction, length=lambda at: 42 + 0 * at[:, 1], height=lambda at: 1.0 + 0.5 * tall(at),
        layers=_HANGING, width=2.1, rows=12, parting=PARTING["middle"], falls=True,
        end=lambda at: -13.4 + 0.9 * before(at), wave=0.7, spread=0.06, gathered=0.5,
    ),
}  # fmt: skip


def roots(template: Template, allowed: Array, spacing: float, rng: Any) -> Array:
    """Places on the triangles of allowed points (n,), at least `spacing` apart."""
    return apart(places(template, allowed, rng), spacing)


def places(template: Template, allowed: Array, rng: Any) -> Array:
    """Many places on the triangles of allowed points (n,)."""
    triangles = template.triangles[allowed[template.triangles].all(axis=1)]
    a, b, c = (template.points[triangles[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    chosen = rng.choice(len(triangles), 30_000, p=area / area.sum())
    u, v = rng.random((2, len(chosen), 1))
    over = u + v > 1
    u, v = np.where(over, 1 - u, u), np.where(over, 1 - v, v)
    return a[chosen] + u * (b - a)[chosen] + v * (c - a)[chosen]


def apart(found: Array, spacing: float) -> Array:
    """Those of places that are at least `spacing` apart, the first ones first."""
    kept = np.ones(len(found), bool)
    for one, near in enumerate(cKDTree(found).query_ball_point(found, spacing)):
        if kept[one]:
            kept[[other for other in near if other > one]] = False
    return found[kept]


def along_parting(found: Array, parting: float) -> Array:
    """Roots close by on both sides of a parting, so that no skin shows but its line."""
    beside = np.abs(found[:, 0] - parting)
    near = found[(beside > 0.12) & (beside < 0.3) & (found[:, 1] > 8) & (found[:, 2] > -4.5)]
    return np.concatenate([apart(near[near[:, 0] > parting], 0.6), apart(near[near[:, 0] < parting], 0.6)])


def combed(skin: Skin, style: Style, root: Array, layer: Layer, rng: Any) -> tuple[Array, Array]:
    """Middle lines (n, rows, 3) of cards from their roots, and the directions (n, rows, 3) across them."""
    count = len(root)
    length = style.length(root) * rng.uniform(0.8, 1.1, count)
    reach = style.height(root) * layer.height * rng.uniform(0.85, 1.1, count)
    if style.falls:
        reach *= 0.35 + 0.65 * step(-3.0, 13.5, root[:, 1])
    reach *= 0.3 + 0.7 * step(0.0, 2.5, above_hairline(root))
    end = np.full(count, -np.inf) if style.end is None else style.end(root)
    end += rng.normal(0, 0.45, count) + layer.shorter * rng.random(count)
    turn = rng.normal(0, style.spread, (count, 3))
    at, line, across = root.copy(), [], []
    for number in range(int(np.ceil(length.max() / DS)) + 2):
        height, normal = skin.under(at)
        way = style.direction(at)
        way = way / np.linalg.norm(way, axis=1, keepdims=True) + turn
        if style.falls:
            normal = outward(at, normal)
            way -= style.inward * step(4.5, 0.5, at[:, 1] - end)[:, None] * radial(at)
        flat = step(4.0, 1.5, height) * (1 - (style.inward > 0) * step(2.0, -2.0, at[:, 1]))  # along the skin
        way -= flat[:, None] * (way * normal).sum(axis=1, keepdims=True) * normal
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        side = np.cross(way, normal) + 0.25 * turn
        line.append(at)
        across.append(side / np.linalg.norm(side, axis=1, keepdims=True))
        at = lifted(skin, style, at + DS * way, reach * _risen(style, number * DS / np.minimum(length, 9.0)))
    line = gaussian_filter1d(np.array(line), 1.5, axis=0, mode="nearest")
    across = gaussian_filter1d(np.array(across), 1.5, axis=0, mode="nearest")
    if style.end is not None:
        length = np.maximum((line[..., 1] > end).sum(axis=0) * DS, 2.0)
    at = _shares(style)[:, None] * np.minimum(length / DS, len(line) - 1.01)
    low, share = at.astype(int), (at % 1)[..., None]
    each = np.arange(count)
    line, across = (one[low, each] * (1 - share) + one[low + 1, each] * share for one in (line, across))
    return np.moveaxis(line, 0, 1), np.moveaxis(across, 0, 1)


def _shares(style: Style) -> Array:
    """(rows,) of the length at which the rows of a card lie: closer at the root, where hair that falls bends."""
    return np.linspace(0, 1, style.rows) ** (1.4 if style.falls else 1.0)


def _risen(style: Style, share: Array) -> Array:
    """How high a hair is over the skin, of its height, at a share of its length."""
    return np.interp(share, [0, 0.12, 0.45, 1], [0.05, 0.55, 1.0, 0.8 + 0.2 * style.falls])


def lifted(skin: Skin, style: Style, at: Array, height: Array) -> Array:
    """Places brought to a height over the skin; what falls hangs freely off the head, beyond the ears."""
    below, normal = skin.under(at)
    lift = height - below
    if not style.falls:
        return at + lift[:, None] * normal
    normal = outward(at, normal)
    lift = np.maximum(lift, 0.3 * lift * step(0.0, 0.5, normal[:, 1]))
    at = at + lift[:, None] * normal
    at[:, 0] = np.copysign(np.maximum(np.abs(at[:, 0]), over_ears(at)), at[:, 0])
    return at


def gathered(style: Style, root: Array, line: Array, across: Array) -> Array:
    """Lines drawn to those of the locks that they are in, the more the nearer their tips, and in waves."""
    along = np.linspace(0, 1, style.rows)[:, None]
    if style.gathered:
        near = np.hstack([root, 0.7 * line[:, style.rows // 2]])
        middle = apart(near, 3.2)
        lock = cKDTree(near).query(middle)[1][cKDTree(middle).query(near)[1]]
        line = line + style.gathered * along**1.5 * (line[lock] - line)
    if style.wave:
        phase = (root @ [0.55, 0.3, 0.4])[:, None]
        far = np.linalg.norm(np.diff(line, axis=1, prepend=line[:, :1]), axis=2).cumsum(axis=1)
        turn = phase + 0.45 * far
        out = np.cross(across, np.gradient(line, axis=1))
        out /= np.linalg.norm(out, axis=2, keepdims=True)
        strength = style.wave * step(4.0, 16.0, far)[..., None]
        line = line + strength * (np.sin(turn)[..., None] * across + 0.6 * np.abs(np.cos(turn))[..., None] * out)
    return line


def hair_grids(template: Template, skin: Skin, style: Style, scalp: Array) -> Grids:
    """Layers of cards: dense ones on the skin, then locks, then thin ones."""
    rng = np.random.default_rng(21)
    points, uvs = [], []
    above = above_hairline(template.points)
    for number, layer in enumerate(style.layers):
        found = places(
            template, (scalp > 0.5) & (above > 0.1 + 0.2 * number) & (template.points[:, 1] > layer.above), rng
        )
        root = apart(found, layer.spacing)
        if style.parting is not None and number < 3:
            root = np.concatenate([along_parting(found, style.parting), root])
        line, across = combed(skin, style, root, layer, rng)
        line = gathered(style, root, line, across)
        rim = above_hairline(root) < 0.9
        half = np.interp(_shares(style), [0, 0.12, 0.7, 1], [0.7, 1, 1, 0.8])[:, None]
        width = style.width * layer.width * np.where(rim, 0.6, 1) * rng.uniform(0.75, 1.2, len(root))
        half = half * 0.5 * width[:, None, None]
        points.append(np.stack([line - half * across, line + half * across], axis=2))
        thin = LONG[3:4] if style.falls else SHORT[4:6]  # a soft hairline
        shown = [thin if edge else layer.locks for edge in rim]
        locks = [some[one % len(some)] for some, one in zip(shown, rng.permutation(len(root)), strict=True)]
        uvs.append(_texture(style, locks, rng))
    points = np.concatenate(points)
    held = np.broadcast_to(points.mean(axis=2, keepdims=True), points.shape)
    return Grids(points, np.concatenate(uvs), held)


def _texture(style: Style, locks: list[Lock], rng: Any) -> Array:
    """(n, rows, 2, 2) texture coordinates of cards that show locks, some of them mirrored."""
    left, bottom, height = (np.array([getattr(lock, name) for lock in locks]) for name in ("left", "bottom", "height"))
    sides = np.where(rng.random((len(locks), 1)) < 0.5, [0.03, 0.97], [0.97, 0.03])
    u = (left[:, None] + WIDE * sides) / 1024
    v = 1 - (bottom[:, None] - 3 - (height[:, None] - 8) * _shares(style)) / 1024
    return np.stack(np.broadcast_arrays(u[:, None, :], v[:, :, None]), axis=-1)


def coil_grids(template: Template, skin: Skin, scalp: Array) -> Grids:
    """Patches of curls, four deep, that lie roughly along the head."""
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
