"""Distances along a surface.

Shortest paths over the edges and diagonals of triangles and quads, and over straight lines across two of them that
share an edge, unfolded into one plane where the line stays inside them. Such paths are a few percent longer than true
geodesics, but need nothing of the shapes of faces, and quads have no preferred diagonal. The heat method (Crane,
Weischedel & Wardetzky 2013) is smoother where triangles are good; on heads, with slivers at lids and lips, its
gradients point anywhere, unless the surface is remeshed first.

Source of the lines across: Lanthier, Maheshwari & Sack, "Approximating shortest paths on weighted polyhedral
surfaces", Algorithmica 2001 (section 3), with the unfolding of Kimmel & Sethian, PNAS 1998.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.polygons import distinct_edges, triangulate

_SHORTEST_EDGE = 1e-12  # shortest edge of the graph, of the largest coordinate: csgraph takes 0 for no edge


def cells(face_vertex_counts: IntArray, face_vertex_indices: IntArray) -> IntArray:
    """(c, 4) the corners of triangles (the last -1) and quads; larger polygons as fans of triangles."""
    counts, indices = np.asarray(face_vertex_counts, np.int64), np.asarray(face_vertex_indices, np.int64)
    starts = np.cumsum(counts) - counts
    quads = indices[starts[counts == 4][:, None] + np.arange(4)].reshape(-1, 4)
    fans = triangulate(counts)
    triangles = indices[fans.corners[counts[fans.faces] != 4]].reshape(-1, 3)
    return np.concatenate([quads, np.pad(triangles, ((0, 0), (0, 1)), constant_values=-1)])


def even_triangles(cells: IntArray) -> IntArray:
    """(t, 3) triangles of `cells`, each once; of quads those of both diagonals: everything twice."""
    quads, triangles = cells[cells[:, 3] >= 0], cells[cells[:, 3] < 0, :3]
    halves = [quads[:, [0, 1, 2]], quads[:, [0, 2, 3]], quads[:, [0, 1, 3]], quads[:, [1, 2, 3]]]
    return np.concatenate([triangles, triangles, *halves])


def surface_graph(points: FloatArray, cells: IntArray, more_edges: IntArray | None = None) -> Any:
    """(n, n) sparse symmetric lengths of the edges and diagonals of `cells` and of the lines across two of them.

    :param points: (n, 3)
    :param cells: (c, 4) corners of triangles and quads, as `cells` gives them
    :param more_edges: (e, 2) other pairs of points that are joined by the straight line between them, such as the
        edges of polygons that are no surface
    """
    from scipy.sparse import csr_array

    points = np.asarray(points, np.float64)
    cells = np.asarray(cells, np.int64).reshape(-1, 4)
    pairs = np.concatenate([cells[:, [a, b]] for a in range(4) for b in range(a + 1, 4)])
    if more_edges is not None:
        pairs = np.concatenate([pairs, np.asarray(more_edges, np.int64).reshape(-1, 2)])
    pairs = pairs[(pairs >= 0).all(axis=1)]
    lengths = np.linalg.norm(points[pairs[:, 1]] - points[pairs[:, 0]], axis=1)
    # the edges that exactly two cells share, and the cells' other corners: -1 for none
    quads, triangles = cells[cells[:, 3] >= 0], cells[cells[:, 3] < 0]
    turns = [np.roll(quads, -i, axis=1) for i in range(4)]
    turns += [triangles[:, [i, (i + 1) % 3, (i + 2) % 3, 3]] for i in range(3)]
    whole = np.concatenate(turns)
    ends, others = whole[:, :2], whole[:, 2:]
    edges, edge, uses = distinct_edges(ends)
    order = np.argsort(edge, kind="stable")
    starts = (np.cumsum(uses) - uses)[uses == 2]
    one, other = others[order[starts]], others[order[starts + 1]]
    found = [_lines(points, edges[uses == 2], one[:, i], other[:, k]) for i in range(2) for k in range(2)]
    pairs = np.concatenate([pairs, *(across for across, _ in found)])
    lengths = np.concatenate([lengths, *(spans for _, spans in found)])
    proper = pairs[:, 0] != pairs[:, 1]
    pairs, lengths = np.sort(pairs[proper], axis=1), lengths[proper]
    lengths = np.maximum(
        lengths, _SHORTEST_EDGE * max(float(np.abs(points).max(initial=0.0)), np.finfo(np.float64).tiny)
    )
    order = np.lexsort((lengths, pairs[:, 1], pairs[:, 0]))  # of lines between the same points the shortest
    pairs, lengths = pairs[order], lengths[order]
    first = np.concatenate([[True], (np.diff(pairs, axis=0) != 0).any(axis=1)]) if len(pairs) else order.astype(bool)
    (a, b), lengths = pairs[first].T, lengths[first]
    both = (np.concatenate([a, b]).astype(np.int32), np.concatenate([b, a]).astype(np.int32))
    return csr_array((np.concatenate([lengths, lengths]), both), shape=(len(points), len(points)))


def _lines(points: FloatArray, edges: IntArray, a: IntArray, b: IntArray) -> tuple[IntArray, FloatArray]:
    """Pairs (m, 2) of those of `a` and `b` (-1: none) whose line crosses their edge, and its length.

    Both cells are unfolded about the edge into one plane: a point s along it and h away from it on one side, t and k on
    the other, have the distance ``hypot(s - t, h + k)``; the line crosses the edge at ``(s k + t h) / (h + k)``.
    """
    there = (a >= 0) & (b >= 0)
    a, b, (first, last) = a[there], b[there], edges[there].T
    low = points[first]
    length = np.linalg.norm(points[last] - low, axis=1)
    axis = (points[last] - low) / np.maximum(length, np.finfo(np.float64).tiny)[:, None]
    along_a, away_a = _unfolded(points[a], low, axis)
    along_b, away_b = _unfolded(points[b], low, axis)
    total = np.maximum(away_a + away_b, np.finfo(np.float64).tiny)
    crossing = (along_a * away_b + along_b * away_a) / total
    inside = (crossing > 0) & (crossing < length) & (away_a > 0) & (away_b > 0)
    spans = np.hypot(along_a - along_b, away_a + away_b)
    return np.stack([a, b], axis=1)[inside], spans[inside]


def _unfolded(points: FloatArray, start: FloatArray, axis: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Coordinates along and away from the edge."""
    offset = points - start
    along = (offset * axis).sum(axis=1)
    return along, np.linalg.norm(offset - along[:, None] * axis, axis=1)


def graph_distances(graph: Any, sources: Sequence[IntArray], starts: Sequence[FloatArray] | None = None) -> FloatArray:
    """(sources, n) distances over a `surface_graph` from each set of points; infinite where no path leads.

    :param sources: point numbers of each set
    :param starts: distance at each point of a set before the path begins, 0 or more; default 0
    """
    from scipy.sparse import csr_array, vstack
    from scipy.sparse.csgraph import dijkstra

    count = graph.shape[0]
    if not len(sources):
        return np.zeros((0, count))
    sizes = [len(source) for source in sources]
    columns = np.concatenate([np.asarray(source, np.int64) for source in sources])
    offsets = (
        np.zeros(len(columns)) if starts is None else np.concatenate([np.asarray(start, float) for start in starts])
    )
    shift = 1.0 + float(offsets.max(initial=0.0))  # csgraph takes 0 for no edge: every start that much further
    rows = np.repeat(np.arange(len(sources)), sizes)
    doors = csr_array((offsets + shift, (rows, columns)), shape=(len(sources), count))
    whole = vstack([graph, doors], format="csr")
    whole.resize((count + len(sources), count + len(sources)))
    whole.indices, whole.indptr = whole.indices.astype(np.int32), whole.indptr.astype(np.int32)
    numbers = np.arange(count, count + len(sources))
    found = dijkstra(whole, directed=True, indices=numbers)[:, :count]
    return np.asarray(np.maximum(found - shift, 0.0))


def nearest_sources(graph: Any, sources: IntArray) -> IntArray:
    """(n,) which of `sources` is nearest to each point over a `surface_graph`; -1 where no path leads."""
    from scipy.sparse.csgraph import dijkstra

    nearest = dijkstra(graph, indices=sources, min_only=True, return_predecessors=True)[2]
    return np.where(nearest < 0, -1, nearest).astype(np.int64)
