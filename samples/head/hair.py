"""Strands of hair that grow on skin, and the cards of locks that show them.

A strand leaves its root the way that its style is combed, keeps a height over the skin, or falls, and is drawn to the
middle of its clump. A card lies along each.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from grids import Grids, Skin
from locks import Lock, shown
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree
from skin_maps import Template, step

Array = Any
DS = 0.35  # cm a step along a strand
LIES = 4.0  # cm over the skin, from which nothing lies on it
CLOSER = 1.4  # rows of cards are closer at roots, where hair that falls bends


@dataclass(frozen=True, kw_only=True)
class Layer:
    """Cards of one depth, in an order whose start lies all over the head: fewer of them are a lower level of detail."""

    count: int
    locks: tuple[Lock, ...]  # of the picture, that they show
    rows: int
    width: float  # cm
    height: float  # share of the style's above the skin
    spread: float = 0.1  # how far cards turn from the combed way
    roll: float = 0.2  # and about it
    shorter: float = 0.0  # share of the length, at most
    longest: float = 99.0  # cm
    rooted: Callable[[Array], Array] | None = None  # how densely, at places; everywhere alike
    inside: float = 0.0  # cm from the hairline, at least
    starts: float = 0.0  # share of the length at which cards start, where what lies below is covered


@dataclass(frozen=True, kw_only=True)
class Style:
    """How hair is combed. Lengths in cm."""

    way: Callable[[Array], Array]  # of places (n, 3), any length
    length: Callable[[Array], Array]  # at roots
    height: Callable[[Array], Array]  # above the skin, at roots
    layers: tuple[Layer, ...]  # from the skin outwards, which is the order in which blended cards are drawn
    grows: Callable[[Array], Array]  # (n,) way inside the hairline, cm, at places
    rise: float = 2.0  # cm along the strand to its full height
    sprouts: float = 0.5  # share of it at its root: cards that lie alike are lit alike, and do not look like scales
    falls: bool = False  # down from the head; else it lies on it to its end
    ends: Callable[[Array, Array], Array] | None = None  # which places (..., n, 3) of strands of roots are beyond them
    inward: float = 0.0  # how much ends turn in
    wave: float = 0.0  # cm
    wavelength: float = 8.0
    curl: float = 0.0  # how far strands go astray, of their way
    clump: float = 0.0  # share of the way to the middle of its clump that a tip goes
    rim: tuple[Lock, ...] = ()  # thin locks along the hairline
    rigid: bool = False  # cards stay with what is at their roots, not with the skin below each of their rows
    side: int = 1024  # texels of the picture
    tail: Callable[[Skin, Any], tuple[Array, Array, tuple[Lock, ...]]] | None = None  # strands of hair that is tied
    tied: Array | None = None  # where


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


def places(template: Template, allowed: Array, rng: Any) -> Array:
    """Many places on the triangles of allowed points (n,)."""
    triangles = template.triangles[allowed[template.triangles].all(axis=1)]
    a, b, c = (template.points[triangles[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    chosen = rng.choice(len(triangles), 12_000, p=area / area.sum())
    u, v = rng.random((2, len(chosen), 1))
    over = u + v > 1
    u, v = np.where(over, 1 - u, u), np.where(over, 1 - v, v)
    return a[chosen] + u * (b - a)[chosen] + v * (c - a)[chosen]


def spread(found: Array, density: Array, count: int) -> Array:
    """As many of the places (n, 3), each as far from those before as it gets, nearer where density (n,) is higher."""
    chosen, away = [], np.full(len(found), np.inf)
    place = int(np.argmax(found[:, 1]))
    for _ in range(count):
        chosen.append(place)
        away = np.minimum(away, np.linalg.norm(found - found[place], axis=1))
        place = int(np.argmax(away * np.sqrt(density)))
    return found[chosen]


def combed(skin: Skin, style: Style, root: Array, layer: Layer, rng: Any) -> tuple[Array, Array]:
    """Strands (steps, n, 3) from their roots, and the directions (steps, n, 3) across their cards."""
    count = len(root)
    length = np.minimum(style.length(root), layer.longest)
    reach = style.height(root) * layer.height * rng.uniform(0.9, 1.1, count)
    reach *= 0.35 + 0.65 * step(0.0, 2.5, style.grows(root))
    if style.falls:
        reach *= 0.35 + 0.65 * step(-3.0, 13.5, root[:, 1])
    turn, drift = rng.normal(0, layer.spread, (2, count, 3))
    at, line, across = root.copy(), [], []
    for number in range(int(np.ceil(length.max() / DS)) + 2):
        height, normal = skin.under(at)
        way = style.way(at)
        drift = 0.9 * drift + rng.normal(0, style.curl, (count, 3))
        way = way / np.linalg.norm(way, axis=1, keepdims=True) + turn + drift
        if style.falls:
            normal = outward(at, normal)
        if style.inward:
            way -= style.inward * step(4.5, 0.5, at[:, 1] + 5.6)[:, None] * radial(at)
        flat = step(LIES, 1.5, height) * (1 - (style.inward > 0) * step(2.0, -2.0, at[:, 1]))
        way -= flat[:, None] * (way * normal).sum(axis=1, keepdims=True) * normal
        way /= np.linalg.norm(way, axis=1, keepdims=True) + 1e-9
        line.append(at)
        side = np.cross(way, normal)
        across.append(side / (np.linalg.norm(side, axis=1, keepdims=True) + 1e-9))
        risen = np.interp(number * DS / style.rise, [0, 0.25, 0.6, 1], [style.sprouts, 0.75, 0.92, 1.0])
        at = lifted(skin, style, at + DS * way, reach * risen)
    line = gaussian_filter1d(np.array(line), 1.5, axis=0, mode="nearest")
    across = gaussian_filter1d(np.array(across), 1.5, axis=0, mode="nearest")
    return line, across + np.cross(across, np.gradient(line, axis=0) / DS) * rng.normal(0, layer.roll, (1, count, 1))


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


def cut(style: Style, layer: Layer, root: Array, line: Array, across: Array, rng: Any) -> tuple[Array, Array]:
    """The rows (n, rows, 3) of strands up to where they end."""
    count, each = len(root), np.arange(len(root))
    length = np.minimum(style.length(root), layer.longest) * rng.uniform(0.82, 1.1, count)
    if style.ends is not None:
        growing = np.logical_and.accumulate(~style.ends(line, root), axis=0)
        length = np.minimum(length, growing.sum(axis=0) * DS + rng.normal(0, 0.4, count))
    length = np.clip(length * (1 - layer.shorter * rng.random(count)), 0.5, None)
    shares = layer.starts + (1 - layer.starts) * along(style, layer.rows)
    at = np.minimum(shares[:, None] * length / DS, len(line) - 1.01)
    low, share = at.astype(int), (at % 1)[..., None]
    kept, aside = (one[low, each] * (1 - share) + one[low + 1, each] * share for one in (line, across))
    return np.moveaxis(kept, 0, 1), np.moveaxis(aside, 0, 1)


def along(style: Style, rows: int) -> Array:
    """(rows,) of the length at which the rows of a card lie."""
    return np.linspace(0, 1, rows) ** (CLOSER if style.falls else 1.0)


def clumped(style: Style, root: Array, line: Array, across: Array) -> Array:
    """Lines (n, rows, 3) drawn to those in the middle of their clumps, the more the nearer their tips, and in waves."""
    share = np.linspace(0, 1, line.shape[1])[:, None]
    if style.clump:
        near = np.hstack([root, 0.7 * line[:, line.shape[1] // 2]])
        middle = spread(near, np.ones(len(near)), max(2, len(near) // 5))
        lock = cKDTree(near).query(middle)[1][cKDTree(middle).query(near)[1]]
        line = line + style.clump * share**1.5 * (line[lock] - line)
    if style.wave:
        phase = (root @ [0.55, 0.3, 0.4])[:, None]
        far = np.linalg.norm(np.diff(line, axis=1, prepend=line[:, :1]), axis=2).cumsum(axis=1)
        turn = phase + 2 * np.pi * far / style.wavelength
        out = np.cross(across, np.gradient(line, axis=1))
        out /= np.linalg.norm(out, axis=2, keepdims=True) + 1e-9
        strength = style.wave * step(3.0, 14.0, far)[..., None]
        line = line + strength * (np.sin(turn)[..., None] * across + 0.6 * np.abs(np.cos(turn))[..., None] * out)
    return line


def ribbons(line: Array, across: Array, width: Array) -> Array:
    """(n, rows, 2, 3) cards along lines, narrower at their ends."""
    across = across / np.linalg.norm(across, axis=2, keepdims=True)
    taper = np.interp(np.linspace(0, 1, line.shape[1]), [0, 0.15, 0.7, 1], [0.75, 1, 1, 0.8])
    half = (0.5 * width[:, None] * taper)[..., None] * across
    return np.stack([line - half, line + half], axis=2)


def hair_grids(template: Template, skin: Skin, style: Style, allowed: Array) -> list[Grids]:
    """Cards layer by layer: sheets on the skin, then locks, then single hairs.

    :param allowed: (n,) points of the template on which hair may grow
    """
    rng, made = np.random.default_rng(21), []
    found = places(template, allowed, rng)
    for layer in style.layers:
        here = found[style.grows(found) > layer.inside]
        density = np.ones(len(here)) if layer.rooted is None else layer.rooted(here)
        root = spread(here[density > 0], density[density > 0], layer.count)
        line, across = cut(style, layer, root, *combed(skin, style, root, layer, rng), rng)
        line = clumped(style, root, line, across)
        width = layer.width * rng.uniform(0.8, 1.2, len(root)) * (0.6 + 0.4 * step(0.2, 1.5, style.grows(root)))
        order = rng.permutation(len(root))
        edge = (style.grows(root) < 0.6) & bool(style.rim)
        kinds = [style.rim if thin else layer.locks for thin in edge]
        locks = [kind[one % len(kind)] for kind, one in zip(kinds, order, strict=True)]
        uv = shown(locks, style.side, along(style, layer.rows), rng)
        points = ribbons(line, across, width)
        held = root[:, None, None] if style.rigid else points.mean(axis=2, keepdims=True)
        made.append(Grids(points, uv, np.broadcast_to(held, points.shape)))
    if style.tail is not None:
        line, across, locks = style.tail(skin, rng)
        uv = shown(
            [locks[one % len(locks)] for one in range(len(line))], style.side, np.linspace(0, 1, line.shape[1]), rng
        )
        points = ribbons(line, across, np.full(len(line), 1.8))
        made.append(Grids(points, uv, np.broadcast_to(style.tied, points.shape)))
    return made
