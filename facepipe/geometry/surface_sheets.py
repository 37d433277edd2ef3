"""Triangle soups as oriented sheets: cut open where more than two triangles meet, and where there is no outside.

Source: Gueziec, Taubin, Lazarus, Horn, "Cutting and Stitching: Converting Sets of Polygons to Manifold Surfaces", TVCG
2001 (cutting: corners are one point only where edges of two triangles connect them).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, kw_only=True)
class Sheets:
    """Triangles whose edges have one or two of them, and how each must turn for all of a sheet to agree."""

    triangles: IntArray  # (t, 3) into source, corners in the order of the input
    source: IntArray  # (m,) point of the input that each point is
    component: IntArray  # (t,) number of the sheet
    turned: BoolArray  # (t,) the other corner order agrees with the rest; the first triangle of a sheet stays
    crowded_edges: int  # of more than two triangles
    one_sided_edges: int  # cut so that a sheet has two sides


class _Pairs(NamedTuple):
    """Edges of exactly two triangles."""

    triangles: IntArray  # (e, 2)
    sides: IntArray  # (e, 2) half edges: 3 triangle + corner where the edge begins
    alike: BoolArray  # (e,) both run through the edge in one direction: one of them is turned


def cut_sheets(triangles: IntArray) -> Sheets:
    """The sheets of triangles (t, 3): no point twice in one, and no two on the same points."""
    pairs, crowded = _pairs(triangles)
    component = _linked(len(triangles), pairs.triangles)
    turned, broken = _orientation(len(triangles), component, pairs)
    whole = _Pairs(pairs.triangles[~broken], pairs.sides[~broken], pairs.alike[~broken])
    moved, source = _points(triangles, whole)
    return Sheets(
        triangles=moved,
        source=source,
        component=component,
        turned=turned,
        crowded_edges=crowded,
        one_sided_edges=int(broken.sum()),
    )


def outwardness(points: FloatArray, triangles: IntArray, component: IntArray) -> FloatArray:
    """How much each sheet (c,) bulges to its outside: 0.28 for a sphere, 0 for a plane, negative where turned in.

    The mean distance of the tangent planes from the sheet's centre, over the root of its area.
    """
    a, b, c = points[triangles].transpose(1, 0, 2)
    area_normals = np.cross(b - a, c - a) / 2
    areas = np.linalg.norm(area_normals, axis=1)
    middles = (a + b + c) / 3
    total = np.bincount(component, areas)
    centre = np.stack([np.bincount(component, areas * column) for column in middles.T], axis=1) / total[:, None]
    heights = np.einsum("tc,tc->t", area_normals, middles - centre[component])
    return np.asarray(np.bincount(component, heights) / total**1.5)


def _pairs(triangles: IntArray) -> tuple[_Pairs, int]:
    """Edges of two triangles, and the number of those of more."""
    start, end = triangles.ravel(), triangles[:, [1, 2, 0]].ravel()
    key = np.minimum(start, end) * (int(triangles.max()) + 1) + np.maximum(start, end)
    order = np.argsort(key, kind="stable")
    first = np.flatnonzero(np.concatenate([[True], np.diff(key[order]) != 0]))
    uses = np.diff(np.concatenate([first, [len(order)]]))
    at = first[uses == 2]
    sides = np.stack([order[at], order[at + 1]], axis=1)
    return _Pairs(sides // 3, sides, start[sides[:, 0]] == start[sides[:, 1]]), int((uses > 2).sum())


def _linked(count: int, links: IntArray) -> IntArray:
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    links = links.astype(np.int32)
    graph = coo_array((np.ones(len(links), np.int8), (links[:, 0], links[:, 1])), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1], np.int64)


def _orientation(count: int, component: IntArray, pairs: _Pairs) -> tuple[BoolArray, BoolArray]:
    """Triangles (t,) to turn, and edges (e,) across which no turning makes them agree.

    Each triangle stands twice in a graph, as it is and turned; edges link the two that agree. What a sheet's first
    triangle reaches tells which to turn. Sheets that reach both of one triangle are one-sided: there a spanning tree
    decides.
    """
    a, b = pairs.triangles.T
    other = np.where(pairs.alike, count, 0)
    links = np.concatenate([np.stack([a, b + other], 1), np.stack([a + count, b + count - other], 1)])
    reached = _linked(2 * count, links)
    first = np.zeros(int(component.max()) + 1, np.int64)
    first[component[::-1]] = np.arange(count)[::-1]
    turned = reached[count:] == reached[first][component]
    one_sided = reached[:count] == reached[count:]
    if not one_sided.any():
        return turned, np.zeros(len(pairs.alike), bool)
    turned[one_sided] = _by_tree(count, np.unique(first[component[one_sided]]), pairs)[one_sided]
    return turned, (turned[a] ^ turned[b]) != pairs.alike


def _by_tree(count: int, roots: IntArray, pairs: _Pairs) -> BoolArray:
    """Triangles (t,) to turn along a breadth-first tree that reaches all sheets through `roots`."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import breadth_first_order

    a, b = pairs.triangles.T
    start = np.full(len(roots), count)  # one more triangle, beside every root
    one, two = np.concatenate([a, start]).astype(np.int32), np.concatenate([b, roots]).astype(np.int32)
    value = np.concatenate([np.where(pairs.alike, 2, 1), np.ones_like(start)])
    graph = coo_array((value, (np.minimum(one, two), np.maximum(one, two))), shape=(count + 1, count + 1)).tocsr()
    graph = (graph + graph.T).tocsr()
    order, before = breadth_first_order(graph, count, directed=False)
    alike = np.asarray(graph[before[order[1:]], order[1:]]).ravel() == 2
    turned = [False] * (count + 1)
    for triangle, parent, flip in zip(order[1:].tolist(), before[order[1:]].tolist(), alike.tolist(), strict=True):
        turned[triangle] = turned[parent] ^ flip
    return np.array(turned[:count])


def _points(triangles: IntArray, pairs: _Pairs) -> tuple[IntArray, IntArray]:
    """Triangles (t, 3) on points of which each has one fan of triangles, and the input's point (m,) of each."""
    corners = triangles.ravel()
    following = np.arange(len(corners)).reshape(-1, 3)[:, [1, 2, 0]].ravel()
    one, two = pairs.sides.T
    # where both run alike their starts are one point, else the start of one is the end of the other
    starts = np.where(pairs.alike, two, following[two])
    ends = np.where(pairs.alike, following[two], two)
    links = np.concatenate([np.stack([one, starts], 1), np.stack([following[one], ends], 1)])
    fan = _linked(len(corners), links)
    _, at, point = np.unique(fan, return_index=True, return_inverse=True)
    order = np.lexsort((at, corners[at]))  # by the input's point
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    return rank[point].reshape(-1, 3), corners[at][order]
