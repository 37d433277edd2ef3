"""Solids of triangles for tests of geometry."""

from __future__ import annotations

import numpy as np


def ball(rings: int = 24, radius: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) and triangles (t, 3) of a closed sphere between parallels, facing outward."""
    around = 2 * rings
    angles = np.pi * np.arange(1, rings) / rings, 2 * np.pi * np.arange(around) / around
    polar, turn = np.meshgrid(*angles, indexing="ij")
    rows = np.stack(
        [np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar) + 0 * turn], axis=2
    ).reshape(-1, 3)
    points = np.concatenate([rows, [[0, 0, 1], [0, 0, -1]]]) * radius
    number = np.arange((rings - 1) * around).reshape(rings - 1, around)
    a, b, c, d = (
        one.ravel() for one in (number[:-1], number[1:], np.roll(number[1:], -1, 1), np.roll(number[:-1], -1, 1))
    )
    top = np.stack([np.full(around, len(rows)), number[0], np.roll(number[0], -1)], axis=1)
    bottom = np.stack([np.full(around, len(rows) + 1), np.roll(number[-1], -1), number[-1]], axis=1)
    return points, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1), top, bottom])


def sheet_and_tetrahedron(size: int) -> np.ndarray:
    """Triangles of a sheet of size x size points, and of a tetrahedron on the 4 points after them."""
    corner = (np.arange(size - 1)[:, None] * size + np.arange(size - 1)).ravel()
    halves = [[corner, corner + 1, corner + size + 1], [corner, corner + size + 1, corner + size]]
    sheet = np.concatenate([np.stack(half, axis=1) for half in halves])
    return np.concatenate([sheet, size * size + np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])])
