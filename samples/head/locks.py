"""Pictures of locks of hair with alpha, for the cards of hair and beards: grey, coloured where they are used.

usage: python samples/head/locks.py facepipe/heads/data
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from strokes import Canvas

Array = Any


@dataclass(frozen=True)
class Lock:
    """A patch of a picture: a lock, its roots at the bottom."""

    left: int  # texels
    bottom: int
    width: int
    height: int
    hairs: int
    tufts: int  # that its hairs end in; 0: they end each for itself
    shortest: float  # share of the height
    shade: float


WIDE = 128  # texels of a straight lock
_LONG = (  # to hang down: sheets from dark to light, locks, thin ones, single hairs
    (100, 0, 0.62, 0.80), (92, 0, 0.60, 0.94), (66, 5, 0.60, 0.90),
    (54, 4, 0.58, 1.00), (28, 3, 0.55, 0.98), (10, 0, 0.60, 1.00),
)  # fmt: skip
_SHORT = (  # rows of sheets, of locks, of thin ones, of single hairs
    (84, 7, 0.35, 0.94), (80, 8, 0.35, 0.98), (64, 6, 0.35, 0.96), (58, 5, 0.40, 1.00),
    (40, 5, 0.36, 0.96), (34, 4, 0.45, 1.00), (22, 0, 0.40, 0.95), (13, 0, 0.45, 1.00),
)  # fmt: skip
LONG = tuple(Lock(WIDE * number, 1024, WIDE, 1024, *row) for number, row in enumerate(_LONG))
SHORT = tuple(
    Lock(768 + WIDE * (number % 2), 1024 - 256 * (number // 2), WIDE, 256, *row) for number, row in enumerate(_SHORT)
)
_CURLS = ((22, 0, 0.75, 0.86), (20, 0, 0.70, 0.96), (15, 0, 0.60, 1.00), (7, 0, 0.60, 1.00))
CURLS = tuple(Lock(128 * number, 512, 128, 256, *row) for number, row in enumerate(_CURLS))
FUZZ = (Lock(0, 256, 256, 256, 120, 0, 1.0, 0.92), Lock(256, 256, 256, 256, 64, 0, 1.0, 1.0))


def straight() -> Canvas:
    """Locks of straight hair, long and short: darker at their roots, each hair of a shade and a length of its own."""
    rng, canvas = np.random.default_rng(13), Canvas(1024, 1024)
    for lock in (*LONG, *SHORT):
        long = lock.height > 512
        tufts = np.sort(rng.uniform(0.1, 0.9, lock.tufts))
        ends = rng.uniform(0.5 + 0.5 * lock.shortest if long else lock.shortest, 1.0, lock.tufts)
        begins = np.where(long, 0.0, rng.uniform(0, 0.14, lock.tufts))
        streaks = rng.normal(0, 0.1, 9)  # broad ones: neighbours have about one shade
        waves = rng.uniform(0, 6.3, 2)
        for start in rng.permutation(np.linspace(0.07, 0.93, lock.hairs)):
            u = np.linspace(0, 1, 24)
            reach = lock.shortest + (1 - lock.shortest) * rng.random() ** 0.8
            way = 0.05 * rng.normal() * u
            if lock.tufts:
                tuft = int(np.abs(tufts - start + rng.normal(0, 0.06)).argmin())
                reach = ends[tuft] * (1 - 0.35 * rng.random() ** 2)
                way = way * 0.5 + (tufts[tuft] - start) * (0.1 * u**1.4 + 0.35 * u**4)
            else:
                reach *= 1 - 0.35 * np.abs(2 * start - 1) ** 3  # a sheet is shorter at its sides, or it ends in a line
            if long:
                way = way + 0.03 * np.sin(7 * u + waves[0]) * u + 0.012 * np.sin(19 * u + waves[1]) * u
            x = np.clip(start + way + 0.012 * np.sin(u * rng.uniform(2, 5) + rng.uniform(0, 6.3)) * u, 0.05, 0.95)
            length = (lock.height - 14) * reach
            root = 5 + (0.10 if long else 0.22) * lock.height * rng.random() ** 1.5 * (0.4 if lock.hairs > 70 else 1.0)
            if lock.tufts:
                root += lock.height * begins[tuft]
            grey = lock.shade * (1 + np.interp(start, np.linspace(0, 1, 9), streaks) + rng.normal(0, 0.12)) * 0.8
            along = np.interp(u, [0, 0.15, 0.5, 1], [0.78, 0.9, 1.0, 1.08] if long else [0.93, 1.0, 1.0, 1.0])
            thick = rng.uniform(3.0, 4.4) * (1.0 if long else 0.85)
            canvas.stroke(
                lock.left + WIDE * x,
                lock.bottom - root - np.maximum(length - root, 20) * u,
                thick * np.interp(u, [0, 0.6, 1], [1, 0.85, 0.22]),
                np.clip(grey * along, 0.14, 1.0),
            )
    return canvas


def curled() -> Canvas:
    """Tight curls, the upper ones lighter, each turn lit on one side: locks that wind, tufts without a direction."""
    rng, canvas = np.random.default_rng(14), Canvas(512, 512)
    for lock in (*CURLS, *FUZZ):
        fuzzy = lock.width == lock.height
        for number in range(lock.hairs):
            u = np.linspace(0, 1, 120)
            radius = rng.uniform(7, 15) * np.interp(u, [0, 0.2, 1], [0.5, 1, 0.9])
            turn = rng.uniform(0, 6.3) + rng.choice([-1, 1]) * u * (
                rng.uniform(12, 20) if fuzzy else rng.uniform(30, 46)
            )
            if fuzzy:
                at, angle = rng.normal(0, 44, 2).clip(-84, 84), rng.uniform(0, 6.3)
                drift = rng.uniform(30, 60) * np.array([np.cos(angle), np.sin(angle)])
                x, y = (lock.width / 2 + at[0] + drift[0] * (u - 0.5), lock.height / 2 + at[1] + drift[1] * (u - 0.5))
            else:
                reach = lock.height * (lock.shortest + (1 - lock.shortest) * rng.random()) - 24
                root = 0.2 * lock.height * rng.random()
                x = lock.width * (rng.uniform(0.14, 0.86) + 0.06 * np.sin(u * rng.uniform(1, 6) + rng.uniform(0, 6.3)))
                y = 12 + root + (reach - root) * u
            x = np.clip(x + radius * np.cos(turn), 5, lock.width - 5)
            y = np.clip(y + 0.8 * radius * np.sin(turn), 5, lock.height - 5)
            grey = lock.shade * (0.42 + 0.42 * number / lock.hairs) * rng.normal(1, 0.08)
            shade = grey * (1 + 0.22 * np.sin(turn + 0.8))
            width = np.interp(u, [0, 0.05, 0.9, 1], [1.6, 4.2, 4.0, 1.0])
            canvas.stroke(lock.left + x, lock.bottom - y, width, shade.clip(0.12, 1))
    return canvas


def shown(locks: Sequence[Lock], side: int, along: Array, rng: Any) -> Array:
    """(n, rows, 2, 2) texture coordinates of cards that show locks, some of them mirrored.

    :param side: texels of the picture
    :param along: (rows,) share of the length at which the rows lie
    """
    left, bottom, width, height = (
        np.array([getattr(lock, name) for lock in locks]) for name in ("left", "bottom", "width", "height")
    )
    sides = np.where(rng.random((len(locks), 1)) < 0.5, [0.03, 0.97], [0.97, 0.03])
    u = (left[:, None] + width[:, None] * sides) / side
    v = 1 - (bottom[:, None] - 3 - (height[:, None] - 8) * along) / side
    return np.stack(np.broadcast_arrays(u[:, None, :], v[:, :, None]), axis=-1)


def main(folder: Path) -> None:
    """Draw and save."""
    straight().save(folder / "hair.png")
    curled().save(folder / "coils.png")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
