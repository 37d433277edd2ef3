"""The styles of hair: how each is combed, and the cards that it is made of."""

from __future__ import annotations

from typing import Any

import numpy as np
from grids import Skin
from hair import Layer, Style
from locks import CURLS, FUZZ, LONG, SHORT, Lock
from skin_maps import above_hairline, step

from facepipe.heads.hairlines import receded

Array = Any
WHORL = np.array([0.8, 13.8, -4.2])
PARTING = 3.1  # cm to the left
MIDDLE = 0.5


def unit(ways: Array) -> Array:
    return ways / (np.linalg.norm(ways, axis=-1, keepdims=True) + 1e-9)


def tall(at: Array) -> Array:
    """(n,) 1 on top of the head, 0 at its sides and back."""
    return step(7.0, 12.5, at[:, 1]) * step(-8.5, -3.0, at[:, 2])


def short(at: Array) -> Array:
    """(n,) lengths of hair that is short at the sides, and shorter still at its lower edge."""
    edge = step(0.2, 3.0, above_hairline(at)) + step(2.0, 6.0, at[:, 2])
    return 1.5 + 1.7 * np.minimum(edge, 1) + 1.4 * tall(at)


def before(at: Array) -> Array:
    """(n,) 1 at the front of the head, 0 behind the ears."""
    return step(-2.0, 5.0, at[:, 2])


def forward(at: Array) -> Array:
    """Away from the whorl, about which hair turns, and to the front."""
    away = at - WHORL
    turning = 0.6 * np.exp(-((away**2).sum(axis=1) / 12.0))[:, None] * np.cross([0.0, 1.0, -0.4], unit(away))
    return unit(away) + turning + [0, 0, 0.25]


def parted(at: Array) -> Array:
    """Away from a parting on the left, swept back from the forehead."""
    side = np.where(at[:, :1] > PARTING, 1.0, -1.0)
    low = step(11.5, 8.0, at[:, 1])[:, None]
    behind = step(0.0, -5.0, at[:, 2])[:, None]
    top = np.column_stack([side, 0 * side, -0.55 + 0 * side])
    down = np.column_stack([0.15 * side, -1 + 0 * side, -0.45 + 0 * side])
    return top * (1 - low) * (1 - behind) + down * np.maximum(low, behind) + forward(at) * 0.15


def falling(at: Array) -> Array:
    """Down on both sides of a parting, from shoulders forward or back."""
    side = np.where(at[:, :1] > MIDDLE, 1.0, -1.0)
    behind, front = step(1.0, -5.0, at[:, 2])[:, None], step(4.0, 8.0, at[:, 2])[:, None]
    low, hanging = step(12.5, 7.0, at[:, 1])[:, None], step(6.5, 2.5, at[:, 1])[:, None]
    back = (-0.2 - 0.45 * behind - 0.45 * front) * (1 - 0.85 * hanging)
    back += np.where(at[:, 2:] > -1.0, 0.7, -0.9) * step(-7.5, -11.5, at[:, 1])[:, None]
    return np.concatenate([side * (1 - 0.6 * behind) * (1 - 0.95 * low), -0.3 - low, back], axis=1)


def below(height: Any) -> Any:
    """Ends at a height of roots."""
    return lambda line, root: line[..., 1] < height(root)


def at_whorl(at: Array) -> Array:
    """(n,) density: close where hair leaves to all sides."""
    return 1 + 14 * np.exp(-((at - WHORL) ** 2).sum(axis=1) / 1.2)


def at_hairline(at: Array) -> Array:
    """(n,) density: none but along the hairline."""
    return (above_hairline(at) < 1.0).astype(float)


def at_edge(at: Array) -> Array:
    """(n,) density: closer along the hairline, where hair that is combed back begins."""
    return 1 + 6 * step(1.0, 0.4, above_hairline(at))


def at_side(at: Array) -> Array:
    """(n,) density: closer along the parting on the left."""
    top = step(8.0, 10.5, at[:, 1]) * step(-6.0, -4.0, at[:, 2])
    return 1 + 5 * top * np.exp(-(((at[:, 0] - PARTING) / 0.6) ** 2))


def beside(parting: float) -> Any:
    """(n,) density: close along a parting, since what grows there covers the rest."""

    def density(at: Array) -> Array:
        top = step(9.0, 11.0, at[:, 1]) * step(-7.0, -5.0, at[:, 2])
        return 0.3 + 0.7 * step(2.0, 9.0, at[:, 1]) + 9 * top * np.exp(-(((at[:, 0] - parting) / 0.8) ** 2))

    return density


def back(at: Array) -> Array:
    """From the forehead to the nape."""
    behind = step(-2.5, -8.0, at[:, 2])
    return np.column_stack([0.04 * at[:, 0], -0.12 - 1.3 * behind, -1 + 0.8 * behind])


def around(at: Array) -> Array:
    """From the whorl down on all sides."""
    low = step(12.8, 8.0, at[:, 1])[:, None]
    return unit((at - WHORL) * [1, 0.3, 1]) * (1 - 0.9 * low) + [0, -1, 0] * low


def to(tied: Array) -> Any:
    """Along the head to where it is tied."""
    return lambda at: unit(tied - at)


def near(tied: Array) -> Any:
    """Ends where hair is tied."""
    return lambda line, root: np.linalg.norm(line - tied, axis=-1) < 0.9


def bowl(line: Array, root: Array) -> Array:
    """Ends at the brows in front, at the jaw at the sides and behind."""
    angle = np.abs(np.degrees(np.arctan2(line[..., 0], line[..., 2] - 0.5)))
    return line[..., 1] < np.interp(angle, [0, 30, 44, 52, 100, 180], [5.6, 5.3, 4.6, -4.6, -4.4, -5.2])


def swept(at: Array) -> Array:
    """Back from the forehead, else away from the whorl."""
    front = (step(-3.0, 1.0, at[:, 2]) * step(7.5, 10.0, at[:, 1]))[:, None]
    return back(at) * front + forward(at) * (1 - front)


def inside_receded(at: Array) -> Array:
    """(n,) cm inside the hairline of those whose hair recedes."""
    return np.minimum(above_hairline(at), receded(at))


def thinning(at: Array) -> Array:
    """(n,) density: little about the whorl and at the receded hairline."""
    bare = np.exp(-((at - WHORL - [-0.8, 0, 0]) ** 2).sum(axis=1) / 7.0)
    return (1 - 0.93 * bare) * (0.35 + 0.65 * step(0.0, 2.5, receded(at)))


def pony(skin: Skin, rng: Any) -> tuple[Array, Array, tuple[Lock, ...]]:
    """Strands that fall from where a tail is tied."""
    count, rows = 56, 11
    angle, radius = rng.uniform(0, 6.28, count), 0.9 * np.sqrt(rng.random(count))
    off = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    at = TAIL + [0, 0.1, -0.1] + 0.6 * radius[:, None] * off
    speed = np.array([0.0, 0.45, -1.0]) + 0.5 * radius[:, None] * off * [1, 0.5, 0] + rng.normal(0, 0.04, (count, 3))
    length = rng.uniform(19, 25, (count, 1)) / (rows - 1)
    line = [at]
    for _ in range(rows - 1):
        speed = unit(speed) + np.array([0.0, -0.75, 0.0])
        at = at + length * unit(speed)
        line.append(at)
    found = np.stack(line, axis=1)
    share = np.linspace(0, 1, rows)[:, None]
    found = found + 0.5 * np.sin(share * 9 + 1.2 * found[:, :1, :1]) * share * [1, 0, 0.5]
    found += off[:, None] * radius[:, None, None] * np.interp(share, [0, 0.35, 1], [0, 2.2, 0.5])
    facing = off + np.array([0.0, 0.2, -0.4])
    return found, np.cross(np.gradient(found, axis=1), facing[:, None]), LONG[:4]


def knot(skin: Skin, rng: Any) -> tuple[Array, Array, tuple[Lock, ...]]:
    """Strands that wind about a bun."""
    count, rows = 90, 8
    axis = unit(np.array([0.0, 0.75, -0.66]))
    side, up = np.array([1.0, 0, 0]), np.cross(axis, [1.0, 0, 0])
    middle = BUN + 2.2 * axis
    start, height = rng.uniform(0, 6.28, (count, 1)), np.sort(rng.uniform(-0.75, 1.2, (count, 1)), axis=0)
    turn = start + np.linspace(0, 2.0, rows)
    lift = height + np.linspace(0, 0.35, rows) + 0.18 * np.sin(turn + rng.uniform(0, 6.3))
    flat = np.cos(lift)[..., None] * (np.cos(turn)[..., None] * side + np.sin(turn)[..., None] * up)
    normal = flat + np.sin(lift)[..., None] * axis
    radius = rng.uniform(3.1, 3.6, (count, 1, 1)) * (1 - 0.06 * np.linspace(0, 1, rows)[:, None] ** 2)
    found = middle + radius * (normal - 0.18 * np.sin(lift)[..., None] * axis)
    return found, np.cross(np.gradient(found, axis=1), normal), LONG[:4]


TAIL, BUN = np.array([0.0, 8.6, -9.3]), np.array([0.0, 12.8, -6.8])
_WISPS = Layer(count=110, locks=SHORT[4:], rows=3, width=1.0, height=0.8, spread=0.3, longest=2.0, rooted=at_hairline)


def _tied(tied: Array) -> tuple[Layer, ...]:
    """Layers of hair that is drawn back tightly."""
    return (
        Layer(count=130, locks=LONG[:2], rows=6, width=2.4, height=0.5, spread=0.03, rooted=at_edge),
        Layer(count=130, locks=LONG[1:4], rows=7, width=1.8, height=1.0, spread=0.04, roll=0.1, rooted=at_edge),
        Layer(count=40, locks=LONG[3:5], rows=7, width=1.5, height=1.25, spread=0.05, roll=0.2),
    )


def _falling(parting: Any, count: float, rows: int) -> tuple[Layer, ...]:
    return (
        Layer(count=60, locks=LONG[:1], rows=rows - 3, width=3.0, height=0.3, spread=0.05, rooted=parting),
        Layer(
            count=int(90 * count),
            locks=LONG[:3],
            rows=rows,
            width=2.5,
            height=0.65,
            spread=0.05,
            shorter=0.05,
            rooted=parting,
        ),
        Layer(
            count=int(78 * count),
            locks=LONG[1:4],
            rows=rows,
            width=2.2,
            height=0.9,
            spread=0.07,
            shorter=0.12,
            rooted=parting,
        ),
        Layer(
            count=int(34 * count),
            locks=LONG[3:5],
            rows=rows,
            width=1.7,
            height=1.1,
            spread=0.1,
            roll=0.3,
            shorter=0.2,
            rooted=parting,
        ),
    )


STYLES = {
    "crop": Style(
        way=forward, grows=above_hairline, rise=2.2,
        length=short, height=lambda at: 0.16 + 0.75 * tall(at),
        rim=SHORT[4:6], layers=(
            Layer(count=220, locks=SHORT[:2], rows=4, width=2.6, height=0.5, inside=0.3, rooted=at_whorl),
            Layer(count=360, locks=LONG[:2], rows=4, width=1.9, height=0.8, spread=0.1, roll=0.1, rooted=at_whorl),
            Layer(count=280, locks=SHORT[1:5], rows=4, width=1.5, height=1.0, spread=0.18, roll=0.1, rooted=at_whorl),
            Layer(count=140, locks=SHORT[4:], rows=4, width=1.3, height=1.1, spread=0.25, roll=0.2),
        ),
    ),
    "buzz": Style(
        way=forward, grows=above_hairline, rise=1.0,
        length=lambda at: 0.8 + 0.3 * tall(at), height=lambda at: 0.2 + 0.1 * tall(at),
        layers=(
            Layer(count=1200, locks=SHORT[7:], rows=2, width=1.3, height=0.7, spread=0.25, roll=0.1, rooted=at_whorl),
            Layer(count=1600, locks=SHORT[7:], rows=2, width=1.3, height=1.4, spread=0.3, roll=0.2, rooted=at_whorl),
        ),
    ),
    "receding": Style(
        way=swept, grows=inside_receded, rise=2.2,
        length=lambda at: 0.85 * short(at), height=lambda at: 0.15 + 0.35 * tall(at),
        rim=SHORT[4:6], layers=(
            Layer(count=220, locks=SHORT[:2], rows=4, width=2.4, height=0.5, inside=0.4, rooted=thinning),
            Layer(count=360, locks=LONG[:2], rows=4, width=1.8, height=0.8, spread=0.1, roll=0.1, rooted=thinning),
            Layer(count=260, locks=SHORT[3:6], rows=4, width=1.4, height=1.0, spread=0.18, roll=0.1, rooted=thinning),
            Layer(count=160, locks=SHORT[5:], rows=4, width=1.3, height=1.1, spread=0.25, roll=0.2),
        ),
    ),
    "parted": Style(
        way=parted, grows=above_hairline, rise=3.0, clump=0.3,
        length=lambda at: short(at) + 3.6 * tall(at), height=lambda at: 0.18 + 1.5 * tall(at),
        rim=SHORT[4:6], layers=(
            Layer(count=170, locks=SHORT[:2], rows=5, width=2.8, height=0.4, spread=0.06, rooted=at_side),
            Layer(count=260, locks=LONG[:2], rows=5, width=1.9, height=0.75, spread=0.08, roll=0.1, rooted=at_side),
            Layer(count=220, locks=SHORT[1:5], rows=5, width=1.6, height=1.0, spread=0.12, roll=0.15, rooted=at_side),
            Layer(count=100, locks=SHORT[4:], rows=5, width=1.3, height=1.1, spread=0.15, roll=0.3),
        ),
    ),
    "slick": Style(
        way=back, grows=above_hairline, rise=3.0, clump=0.25,
        length=lambda at: 6.0 + 6.0 * tall(at), height=lambda at: 0.3 + 0.9 * tall(at),
        ends=below(lambda at: -4.2 + 0 * at[:, 0]),
        layers=(
            Layer(count=120, locks=LONG[:2], rows=6, width=2.6, height=0.4, spread=0.04, rooted=at_edge),
            Layer(count=190, locks=LONG[1:4], rows=7, width=1.8, height=0.8, spread=0.05, roll=0.1, rooted=at_edge),
            Layer(count=120, locks=LONG[2:5], rows=7, width=1.5, height=1.0, spread=0.07, roll=0.2, rooted=at_edge),
            Layer(count=50, locks=LONG[4:], rows=6, width=1.2, height=1.1, spread=0.1, roll=0.3),
            _WISPS,
        ),
    ),
    "fringe": Style(
        way=around, grows=above_hairline, rise=6.0, falls=True, sprouts=0.1,
        length=lambda at: 34 + 0 * at[:, 1], height=lambda at: 0.9 + 0.5 * tall(at),
        ends=bowl, inward=0.35, clump=0.25,
        layers=(
            Layer(count=80, locks=LONG[:1], rows=8, width=3.0, height=0.3, spread=0.03, rooted=at_whorl),
            Layer(count=130, locks=LONG[:3], rows=9, width=2.2, height=0.65, spread=0.04, rooted=at_whorl),
            Layer(count=110, locks=LONG[1:4], rows=9, width=2.0, height=0.85, spread=0.05, rooted=at_whorl),
            Layer(count=50, locks=LONG[3:5], rows=9, width=1.6, height=1.0, spread=0.07, roll=0.2, shorter=0.06),
        ),
    ),
    "bob": Style(
        way=falling, grows=above_hairline, rise=9.0, falls=True, sprouts=0.15,
        length=lambda at: 34 + 0 * at[:, 1], height=lambda at: 1.0 + 0.6 * tall(at),
        ends=below(lambda at: -5.8 - 1.4 * before(at)), inward=0.6, wave=0.7, wavelength=9.5, clump=0.4,
        layers=_falling(beside(MIDDLE), 1.0, 13),
    ),
    "long": Style(
        way=falling, grows=above_hairline, rise=9.0, falls=True, sprouts=0.15,
        length=lambda at: 46 + 0 * at[:, 1], height=lambda at: 1.0 + 0.6 * tall(at),
        ends=below(lambda at: -15.0 + 0.9 * before(at)), wave=0.9, wavelength=12.0, clump=0.5,
        layers=_falling(beside(MIDDLE), 0.83, 15),
    ),
    "bun": Style(
        way=to(BUN), grows=above_hairline, rise=2.5, length=lambda at: 34 + 0 * at[:, 0],
        height=lambda at: 0.4 + 0.3 * tall(at), ends=near(BUN), layers=(*_tied(BUN), _WISPS), tail=knot, tied=BUN,
    ),
    "ponytail": Style(
        way=to(TAIL), grows=above_hairline, rise=2.5, length=lambda at: 34 + 0 * at[:, 0],
        height=lambda at: 0.4 + 0.4 * tall(at), ends=near(TAIL), layers=(*_tied(TAIL), _WISPS), tail=pony, tied=TAIL,
    ),
    "coils": Style(
        way=forward, grows=above_hairline, rise=0.8, side=512, curl=0.25,
        length=lambda at: 2.8 + 0.5 * tall(at), height=lambda at: 0.9 + 1.2 * tall(at),
        layers=(
            Layer(count=500, locks=FUZZ[:1], rows=2, width=2.0, height=0.2, spread=0.7, inside=0.3, starts=0.2),
            Layer(count=700, locks=FUZZ[:1] + CURLS[:2], rows=2, width=1.7, height=0.5, spread=0.7, starts=0.3),
            Layer(count=800, locks=CURLS[:3], rows=2, width=1.4, height=0.8, spread=0.8, roll=0.3, starts=0.3),
            Layer(count=900, locks=CURLS[1:], rows=2, width=1.3, height=1.0, spread=0.9, roll=0.5, starts=0.3),
        ),
    ),
    "afro": Style(
        way=forward, grows=above_hairline, rise=0.8, side=512, curl=0.3,
        length=lambda at: 3.4 + 0 * at[:, 0], height=lambda at: 3.4 + 1.4 * tall(at),
        layers=(
            Layer(count=400, locks=FUZZ[:1], rows=2, width=2.4, height=0.1, spread=1.0, inside=0.3, starts=0.2),
            Layer(count=600, locks=FUZZ[:1], rows=2, width=2.8, height=0.5, spread=1.5, roll=0.2, starts=0.2),
            Layer(count=900, locks=FUZZ[:1], rows=2, width=2.8, height=0.8, spread=2.0, roll=0.2, starts=0.2),
            Layer(count=1100, locks=FUZZ, rows=2, width=2.6, height=1.0, spread=2.5, roll=0.3, starts=0.2),
        ),
    ),
}  # fmt: skip
