"""Small holes of a surface, closed so that a picture of it shows none."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray


def small_holes(points: FloatArray, triangles: IntArray, largest: float) -> list[IntArray]:
    """The border loops of an oriented manifold whose bounding box is at most `largest` along its diagonal.

    Each as the points (k,) around the hole, in the order in which the missing triangles would run.
    """
    following = _border(triangles, len(points))
    loops = []
    for start in list(following):
        loop = []
        at: int | None = start
        while at is not None and at in following:
            loop.append(at)
            at = following.pop(at)
        if len(loop) > 2 and at == start:
            corners = points[loop]
            if np.linalg.norm(np.ptp(corners, axis=0)) <= largest:
                loops.append(np.array(loop))
    return loops


def border_points(points: FloatArray, triangles: IntArray) -> IntArray:
    """The points (b,) on edges of one triangle of an oriented manifold."""
    return np.array(sorted(_border(triangles, len(points))), dtype=np.int64)


def _border(triangles: IntArray, count: int) -> dict[int, int]:
    """The point after each border point, against the triangles' order; one of them where loops touch."""
    start, end = triangles.ravel().astype(np.int64), triangles[:, [1, 2, 0]].ravel().astype(np.int64)
    alone = ~np.isin(start * count + end, end * count + start, kind="sort")
    return dict(zip(end[alone].tolist(), start[alone].tolist(), strict=True))
