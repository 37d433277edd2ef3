"""Left and right: which point is whose mirror image, and shapes made alike."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]

FLIP = np.array([-1.0, 1.0, 1.0])

Edge = tuple[int, int]


def twin(name: str) -> str:
    """The name of what is on the other side."""
    return name.replace("Left", "#").replace("Right", "Left").replace("#", "Right")


def mirror_points(points: Floats, shapes: dict[str, Floats], faces: Ints, counts: Ints) -> Ints:
    """(n,) the point on the other side of each.

    Where points are and how shapes move them says it of one face of each piece; from there it goes from face to face.

    :raises ValueError: the sides are not alike
    """
    own = np.hstack([points, *shapes.values()])
    other = np.hstack([points * FLIP, *(shapes[twin(name)] * FLIP for name in shapes)])
    guess = cKDTree(own).query(other)[1]
    ends = np.cumsum(counts)
    polygons = [tuple(faces[end - count : end]) for count, end in zip(counts, ends, strict=True)]
    rings = {(a, b): ring[i:] + ring[:i] for ring in polygons for i, (a, b) in enumerate(pairwise((*ring, ring[0])))}
    found = np.full(len(points), -1)
    for ring in polygons:
        if found[ring[0]] < 0 and (guess[ring[1]], guess[ring[0]]) in rings:
            _spread(ring, (guess[ring[1]], guess[ring[0]]), rings, found)
    if (found < 0).any() or (found[found] != np.arange(len(found))).any():
        raise ValueError("the sides of the head are not alike, expected a mirror image of every point")
    return found.astype(np.int32)


def _spread(ring: tuple[int, ...], image: Edge, rings: dict[Edge, tuple[int, ...]], found: Ints) -> None:
    """Find the images of a piece's points: a ring's first edge lies on `image`, whose face is its mirror image."""
    waiting, seen = [(ring, image)], set()
    while waiting:
        ring, image = waiting.pop()
        if frozenset(ring) in seen:
            continue
        seen.add(frozenset(ring))
        there = rings[image]
        found[list(ring)] = [there[1], there[0], *there[:1:-1]]
        for a, b in pairwise((*ring, ring[0])):
            if (b, a) in rings:  # the face on the other side of the edge
                waiting.append((rings[b, a], (found[a], found[b])))


def evened(shapes: dict[str, Floats], mirror: Ints) -> dict[str, Floats]:
    """The shapes, each the mean of itself and of its twin mirrored: scans are never quite symmetric."""
    return {name: (shape + shapes[twin(name)][mirror] * FLIP) / 2 for name, shape in shapes.items()}
