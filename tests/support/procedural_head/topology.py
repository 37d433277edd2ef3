"""The head's one topology: a closed grid around the head, a cap on the crown, and ring patches in openings.

Columns run around the head (0 at the front, rising towards the subject's left, +X), rows from the crown down to the
neck border. A patch replaces a block of grid cells with concentric rings; `spokes` of a patch are numbered
counterclockwise as seen from outside, from the middle of the block's high-column side over the upper side to the
middle of the low-column side (spoke `half`) and back along the lower side. The last ring is closed by pairing upper
and lower spokes, so that the whole head is one manifold with one border: the neck.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.geometry.polygons import edges

COLUMNS = 80
CAP = COLUMNS // 4  # cells along one side of the crown cap


@dataclass(frozen=True)
class Block:
    """Cells of the grid that a patch replaces: columns c0..c1, rows r0..r1 (r0 is higher up), and its rings."""

    c0: int
    c1: int
    r0: int
    r1: int
    rings: int

    @property
    def half(self) -> int:
        """Spokes from one corner to the other."""
        return self.c1 - self.c0 + self.r1 - self.r0

    def perimeter(self) -> list[tuple[int, int]]:
        """(column, row) of every spoke on the block's outline."""
        middle = (self.r0 + self.r1) // 2
        right = [(self.c1, r) for r in range(middle, self.r0, -1)]
        top = [(c, self.r0) for c in range(self.c1, self.c0, -1)]
        left = [(self.c0, r) for r in range(self.r0, self.r1)]
        bottom = [(c, self.r1) for c in range(self.c0, self.c1)]
        return right + top + left + bottom + [(self.c1, r) for r in range(self.r1, middle, -1)]

    def mirrored(self) -> Block:
        """The same block on the other side of the face."""
        return Block(-self.c1, -self.c0, self.r0, self.r1, self.rings)


# Levels of the skull (see skull.py) at the grid's rows, so that blocks fall on the features they are for.
_SPANS = (
    (3.0, 4.6, 4),
    (4.6, 6.0, 6),
    (6.0, 7.64, 10),
    (7.64, 8.6, 6),
    (8.6, 8.92, 4),
    (8.92, 9.02, 1),
    (9.02, 11.14, 14),
    (11.14, 13.0, 7),
)
_NECK_SPANS = ((13.0, 15.0, 5), (15.0, 17.0, 3))


@cache
def row_levels() -> FloatArray:
    """(rows,) skull level of every row."""
    levels = [np.linspace(a, b, n, endpoint=False) for a, b, n in (*_SPANS, *_NECK_SPANS)]
    return np.append(np.concatenate(levels), 17.0)


BLOCKS = {
    "mouth": Block(-14, 14, 31, 45, 15),
    "eyeLeft": Block(6, 19, 10, 20, 10),
    "nostrilLeft": Block(1, 4, 26, 30, 3),
    "earLeft": Block(26, 31, 14, 32, 8),
}
BLOCKS["eyeRight"] = BLOCKS["eyeLeft"].mirrored()
BLOCKS["nostrilRight"] = BLOCKS["nostrilLeft"].mirrored()
BLOCKS["earRight"] = BLOCKS["earLeft"].mirrored()


@dataclass(frozen=True)
class Topology:
    """Faces of the head and where each point lies in the layout."""

    face_vertex_counts: IntArray  # (faces,)
    face_vertex_indices: IntArray  # (corners,)
    mirror: IntArray  # (n,) the point on the other side
    grid: IntArray  # (rows, COLUMNS) point indices, -1 inside blocks
    cap: IntArray  # (CAP + 1, CAP + 1) point indices [front to back][right to left side]
    rings: dict[str, IntArray]  # block -> (rings + 1, 2 half) point indices, ring 0 is the block's outline
    cap_faces: IntArray  # faces of the crown cap
    point_count: int

    def averaging(self) -> Any:
        """Sparse (n, n) matrix that gives every point the mean of its edge neighbours."""
        return _averaging(self.point_count, edges(self.face_vertex_counts, self.face_vertex_indices)[0])


def _averaging(count: int, pairs: IntArray) -> Any:
    from scipy.sparse import coo_array, diags_array

    ends = np.concatenate([pairs, pairs[:, ::-1]])
    graph = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(count, count)).tocsr()
    return (diags_array(1.0 / np.asarray(graph.sum(axis=1)).ravel()) @ graph).tocsr()


@cache
def build() -> Topology:
    """The topology, always the same."""
    rows = len(row_levels())
    covered = _covered_cells(rows)
    grid, count = _number_grid(rows)
    cap, count = _number_cap(grid, count)
    rings: dict[str, IntArray] = {}
    for name, block in BLOCKS.items():
        outline = np.array([grid[r, c % COLUMNS] for c, r in block.perimeter()])
        new = np.arange(block.rings * 2 * block.half).reshape(block.rings, -1) + count
        rings[name], count = np.concatenate([outline[None], new]), count + new.size
    faces = _grid_faces(grid, covered)
    cap_start = len(faces)
    faces += _cap_faces(cap)
    cap_faces = np.arange(cap_start, len(faces), dtype=np.int32)
    for ring in rings.values():
        faces += _ring_faces(ring)
    counts = np.array([len(face) for face in faces], dtype=np.int32)
    indices = np.array([point for face in faces for point in face], dtype=np.int32)
    return Topology(counts, indices, _mirror(grid, cap, rings, count), grid, cap, rings, cap_faces, count)


def _covered_cells(rows: int) -> BoolArray:
    covered = np.zeros((rows - 1, COLUMNS), dtype=bool)
    for block in BLOCKS.values():
        columns = np.arange(block.c0, block.c1) % COLUMNS
        covered[block.r0 : block.r1, columns] = True
    return covered


def _number_grid(rows: int) -> tuple[IntArray, int]:
    inside = np.zeros((rows, COLUMNS), dtype=bool)
    for block in BLOCKS.values():
        columns = np.arange(block.c0 + 1, block.c1) % COLUMNS
        inside[block.r0 + 1 : block.r1, columns] = True
    grid = np.full((rows, COLUMNS), -1, dtype=np.int32)
    grid[~inside] = np.arange((~inside).sum())
    return grid, int((~inside).sum())


def _number_cap(grid: IntArray, count: int) -> tuple[IntArray, int]:
    cap = np.full((CAP + 1, CAP + 1), -1, dtype=np.int32)
    eighth = COLUMNS // 8
    steps = np.arange(CAP + 1)
    cap[0, steps] = grid[0, (steps - eighth) % COLUMNS]
    cap[steps, CAP] = grid[0, steps + eighth]
    cap[CAP, CAP - steps] = grid[0, steps + 3 * eighth]
    cap[CAP - steps, 0] = grid[0, (steps + 5 * eighth) % COLUMNS]
    inner = (CAP - 1) ** 2
    cap[1:-1, 1:-1] = np.arange(count, count + inner).reshape(CAP - 1, CAP - 1)
    return cap, count + inner


def _grid_faces(grid: IntArray, covered: BoolArray) -> list[tuple[int, ...]]:
    faces: list[tuple[int, ...]] = []
    for row, column in np.argwhere(~covered):
        right = (column + 1) % COLUMNS
        faces.append((grid[row + 1, column], grid[row + 1, right], grid[row, right], grid[row, column]))
    return faces


def _cap_faces(cap: IntArray) -> list[tuple[int, ...]]:
    return [(cap[b, a], cap[b, a + 1], cap[b + 1, a + 1], cap[b + 1, a]) for b in range(CAP) for a in range(CAP)]


def _ring_faces(ring: IntArray) -> list[tuple[int, ...]]:
    spokes = ring.shape[1]
    half = spokes // 2
    faces: list[tuple[int, ...]] = []
    for outer, inner in pairwise(ring):
        for s in range(spokes):
            following = (s + 1) % spokes
            faces.append((outer[s], outer[following], inner[following], inner[s]))
    last = ring[-1]
    faces.append((last[0], last[1], last[-1]))
    faces += [(last[s], last[s + 1], last[spokes - s - 1], last[spokes - s]) for s in range(1, half - 1)]
    faces.append((last[half - 1], last[half], last[half + 1]))
    return faces


def _mirror(grid: IntArray, cap: IntArray, rings: dict[str, IntArray], count: int) -> IntArray:
    mirror = np.arange(count, dtype=np.int32)
    columns = -np.arange(COLUMNS) % COLUMNS
    known = grid >= 0
    mirror[grid[known]] = grid[:, columns][known]
    mirror[cap] = cap[:, ::-1]
    for name, ring in rings.items():
        twin = name.replace("Left", "#").replace("Right", "Left").replace("#", "Right")
        spokes = (ring.shape[1] // 2 - np.arange(ring.shape[1])) % ring.shape[1]
        mirror[ring] = rings[twin][:, spokes]
    return mirror
