"""Scanned surfaces as registration wants them: manifold, oriented outward, without junk; clouds with normals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.geometry.polygons import components, distinct_edges, distinct_rows, merge_points

_POINTS_AT_ONCE = 50_000  # points at once
_LONE_DISTANCE = 6.0  # times the median distance of neighbours: farther off, a point is junk
_LEAST_TURN_COST = 0.05  # of turning neighbours: keeps weights of the tree above 0
_THIN_AREA = 1e-10  # doubled area over the squared longest edge: below, a triangle has no normal
_LEAST_BULGE = 0.02  # outwardness below which a sheet's outside is open; a sphere's is 0.28


class CloudNormals(NamedTuple):
    """Oriented normals of a cloud."""

    normals: FloatArray  # (n, 3) unit length
    spacing: FloatArray  # (n,) mean distance of the neighbours
    lone: BoolArray  # (n,) far from all others


def cloud_normals(points: FloatArray, neighbours: int = 16) -> CloudNormals:
    """Normals by the flattest direction of each point's neighbours, turned alike from point to point, outward.

    Connected pieces are turned so that they bulge outward, each on its own.

    :param points: (n, 3) different points, n over 3
    :param neighbours: points that a tangent plane is fitted to
    :raises InputError: too few points
    """
    from scipy.spatial import cKDTree

    if len(points) < 4:
        raise InputError("cloud", f"{len(points)} points, expected at least 4")
    count = min(neighbours, len(points) - 1)
    distances, near = cKDTree(points).query(points, k=count + 1)
    spacing = distances[:, 1:].mean(axis=1)
    # the eigenvector of least eigenvalue of ``sum (p - mean) (p - mean)^T`` is the normal of the plane of least squares
    flat = np.empty((len(points), 3))
    for start in range(0, len(points), _POINTS_AT_ONCE):
        around = points[near[start : start + _POINTS_AT_ONCE]]
        around = around - around.mean(axis=1, keepdims=True)
        _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))
        flat[start : start + _POINTS_AT_ONCE] = axes[:, :, 0]
    linked = near[:, 1:]
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components, minimum_spanning_tree

    size = len(points)
    first, second = np.repeat(np.arange(size, dtype=np.int32), linked.shape[1]), linked.ravel().astype(np.int32)
    first, second = np.minimum(first, second), np.maximum(first, second)
    links = np.sort(first.astype(np.int64) * size + second)
    links = links[np.diff(links, prepend=-1) > 0]
    first, second = (links // size).astype(np.int32), (links % size).astype(np.int32)
    turn = 1.0 + _LEAST_TURN_COST - np.abs(np.einsum("ei,ei->e", flat[first], flat[second]))
    tree = minimum_spanning_tree(coo_array((turn, (first, second)), shape=(size, size)).tocsr()).tocoo()
    piece = connected_components(tree, directed=False)[1]
    turned = flat * _signs(tree.row, tree.col, piece, flat)[:, None]
    # (p,) 1 for pieces whose normals point away from their middle, -1 for others
    counts = np.bincount(piece)
    middle = np.stack([np.bincount(piece, column) for column in points.T], axis=1) / counts[:, None]
    heights = np.bincount(piece, np.einsum("ni,ni->n", turned, points - middle[piece]))
    normals = np.asarray(turned * np.where(heights < 0, -1.0, 1.0)[piece, None])
    return CloudNormals(normals, spacing, spacing > _LONE_DISTANCE * np.median(spacing))


def _signs(first: IntArray, second: IntArray, piece: IntArray, normals: FloatArray) -> FloatArray:
    """(n,) signs along the trees with the edges `first` to `second`, 1 at the first point of each piece."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import breadth_first_order

    count = len(normals)
    roots = np.unique(piece, return_index=True)[1]
    start = np.full(len(roots), count)  # one more point, beside every root
    row, column = np.concatenate([first, start]).astype(np.int32), np.concatenate([second, roots]).astype(np.int32)
    graph = coo_array((np.ones(len(row), np.int8), (row, column)), shape=(count + 1, count + 1)).tocsr()
    order, before = breadth_first_order(graph, count, directed=False)
    order, parents = order[1:], before[order[1:]]
    inner = parents < count
    flips = np.zeros(len(order), bool)
    flips[inner] = np.einsum("ni,ni->n", normals[order[inner]], normals[parents[inner]]) < 0
    signs = [1.0] * (count + 1)
    for point, parent, flip in zip(order.tolist(), parents.tolist(), flips.tolist(), strict=True):
        signs[point] = -signs[parent] if flip else signs[parent]
    return np.array(signs[:count])


@dataclass(frozen=True, kw_only=True)
class SurfaceReport:
    """Counts of repairs."""

    merged_points: int = 0  # at the place of another
    flat_triangles: int = 0  # without area, dropped
    repeated_triangles: int = 0  # of the same three points, dropped
    unused_points: int = 0  # of no triangle, dropped
    components: int = 0  # that stay
    small_components: int = 0  # dropped
    small_triangles: int = 0  # in those
    non_manifold_edges: int = 0  # of more than two triangles once junk is gone, cut open
    one_sided_edges: int = 0  # cut open, since a Moebius band has no outside
    split_points: int = 0  # copies that cuts and pinched points made
    turned_triangles: int = 0  # corners put in the other order
    border_points: int = 0


@dataclass(frozen=True, kw_only=True)
class CleanSurface:
    """A mended surface: each edge has one or two triangles, of one orientation, outward where the shape decides it."""

    points: FloatArray  # (m, 3)
    triangles: IntArray  # (t, 3)
    source: IntArray  # (m,) the point of the scan that each one is
    border: BoolArray  # (m,) on an edge of one triangle
    component: IntArray  # (m,) number of the connected piece, the largest first
    report: SurfaceReport


def clean_surface(points: FloatArray, triangles: IntArray, *, smallest: float = 0.01) -> CleanSurface:
    """Mend the surface of a scan; holes stay as they are.

    Junk is dropped: triangles without area, and pieces that hold less than `smallest` of the largest one's area, fins
    on other pieces among them. Edges of more than two triangles, and seams of one-sided pieces, are cut open. Pieces
    are oriented alike within, and outward where their bulge decides it; flat ones as most of their triangles were.

    :param points: (n, 3)
    :param triangles: (t, 3)
    :param smallest: share of the largest piece's area
    :raises InputError: nothing is left
    """
    first, place = merge_points(points)
    merged = np.asarray(points, dtype=np.float64)[first]
    corners = place[np.asarray(triangles, dtype=np.int64)]
    a, b, c = merged[corners].transpose(1, 0, 2)
    doubled = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    longest = np.max([((b - a) ** 2).sum(axis=1), ((c - b) ** 2).sum(axis=1), ((a - c) ** 2).sum(axis=1)], axis=0)
    sound = np.asarray(doubled > _THIN_AREA * longest)
    corners = corners[sound]
    corners = corners[distinct_rows(np.sort(corners, axis=1))[0]]
    if not len(corners):
        raise InputError("surface", "no triangle with an area, expected a scanned surface")
    sheets = cut_sheets(corners)
    areas = np.bincount(sheets.component, _areas(merged, corners))
    large = areas >= smallest * areas.max()
    kept, small = np.asarray(large[sheets.component]), int((~large).sum())
    sheets = sheets if kept.all() else cut_sheets(corners[kept])  # what only junk kept apart joins again
    turned = sheets.turned ^ _inward(merged, sheets)
    oriented = np.where(turned[:, None], sheets.triangles[:, ::-1], sheets.triangles)
    piece = _by_area(merged[sheets.source], oriented, sheets.component)
    edges, _, uses = distinct_edges(oriented[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2))
    border = np.zeros(len(sheets.source), bool)
    border[edges[uses == 1]] = True
    report = SurfaceReport(
        merged_points=len(points) - len(first),
        flat_triangles=int((~sound).sum()),
        repeated_triangles=int(sound.sum()) - len(corners),
        unused_points=len(first) - _used(corners),
        components=int(piece.max()) + 1,
        small_components=small,
        small_triangles=int((~kept).sum()),
        non_manifold_edges=sheets.crowded_edges,
        one_sided_edges=sheets.one_sided_edges,
        split_points=len(sheets.source) - _used(sheets.source),
        turned_triangles=int(turned.sum()),
        border_points=int(border.sum()),
    )
    return CleanSurface(
        points=merged[sheets.source],
        triangles=oriented.astype(np.int32),
        source=first[sheets.source],
        border=border,
        component=piece,
        report=report,
    )


def _used(numbers: IntArray) -> int:
    """The number of different values."""
    return int(np.count_nonzero(np.bincount(numbers.ravel())))


def _areas(points: FloatArray, triangles: IntArray) -> FloatArray:
    a, b, c = points[triangles].transpose(1, 0, 2)
    return np.asarray(np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2)


def _inward(points: FloatArray, sheets: Sheets) -> BoolArray:
    """Triangles (t,) of pieces that, turned as `sheets` has them, face inward or against what most of them did."""
    triangles = np.where(sheets.turned[:, None], sheets.triangles[:, ::-1], sheets.triangles)
    placed = points[sheets.source]
    component = sheets.component
    bulge = _bulge(placed, triangles, component)
    mostly_turned = np.bincount(sheets.component, np.where(sheets.turned, 1.0, -1.0)) > 0
    inward = np.where(np.abs(bulge) >= _LEAST_BULGE, bulge < 0, mostly_turned)
    return np.asarray(inward[sheets.component])


def _bulge(points: FloatArray, triangles: IntArray, component: IntArray) -> FloatArray:
    """(c,) how far pieces bulge to their outside: 0.28 for a sphere, 0 for a plane, negative where turned in.

    ``sum_t A_t u_t . (m_t - centre) / (sum_t A_t)^1.5`` of areas A, unit normals u and middles m of triangles: the
    mean distance of tangent planes from the centre, over the root of the area; ``1 / sqrt(4 pi)`` for a sphere.

    :param component: (t,) piece of each triangle
    """
    a, b, c = points[triangles].transpose(1, 0, 2)
    area_normals = np.cross(b - a, c - a) / 2
    areas = np.linalg.norm(area_normals, axis=1)
    middles = (a + b + c) / 3
    total = np.maximum(np.bincount(component, areas), np.finfo(np.float64).tiny)
    centre = np.stack([np.bincount(component, areas * column) for column in middles.T], axis=1) / total[:, None]
    heights = np.einsum("tc,tc->t", area_normals, middles - centre[component])
    return np.asarray(np.bincount(component, heights) / total**1.5)


def outward_triangles(points: FloatArray, triangles: IntArray) -> tuple[IntArray, BoolArray]:
    """(u, 3) different triangles of a surface, corners of each sheet in the order of most of it, and of each connected
    piece so that it bulges outward; and (u,) which were turned for it.

    For what needs normals of a surface whose points must stay: exporters leave files with any part of their triangles
    turned, and with triangles twice, once for each side, whose normals add up to nothing.

    :param points: (n, 3)
    :param triangles: (t, 3) each of three different points
    """
    corners = np.asarray(triangles, np.int64)
    corners = corners[distinct_rows(np.sort(corners, axis=1))[0]]
    sheets = cut_sheets(corners)
    votes = np.bincount(sheets.component, np.where(sheets.turned, -1.0, 1.0) * _areas(points, corners))
    turned = sheets.turned ^ (votes < 0)[sheets.component]
    alike = np.where(turned[:, None], corners[:, ::-1], corners)
    piece = components(len(points), np.concatenate([corners[:, :2], corners[:, 1:]]))[corners[:, 0]]
    turned ^= (_bulge(points, alike, piece) < -_LEAST_BULGE)[piece]
    return np.where(turned[:, None], corners[:, ::-1], corners), turned


def _by_area(points: FloatArray, triangles: IntArray, component: IntArray) -> IntArray:
    """(m,) piece of every point, the largest 0."""
    order = np.argsort(-np.bincount(component, _areas(points, triangles)), kind="stable")
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    piece = np.zeros(len(points), np.int64)
    piece[triangles] = rank[component][:, None]
    return piece


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
    """The sheets of triangles (t, 3): no point twice in one, and no two on the same points.

    Corners are one point only where edges of two triangles connect them: Gueziec, Taubin, Lazarus, Horn, "Cutting and
    Stitching: Converting Sets of Polygons to Manifold Surfaces", TVCG 2001.
    """
    start, end = triangles.ravel(), triangles[:, [1, 2, 0]].ravel()
    key = np.minimum(start, end) * (int(triangles.max()) + 1) + np.maximum(start, end)
    order = np.argsort(key, kind="stable")
    first = np.flatnonzero(np.concatenate([[True], np.diff(key[order]) != 0]))
    uses = np.diff(np.concatenate([first, [len(order)]]))
    at = first[uses == 2]
    sides = np.stack([order[at], order[at + 1]], axis=1)
    pairs, crowded = _Pairs(sides // 3, sides, start[sides[:, 0]] == start[sides[:, 1]]), int((uses > 2).sum())
    component = components(len(triangles), pairs.triangles)
    turned, broken = _orientation(len(triangles), component, pairs)
    whole = _Pairs(pairs.triangles[~broken], pairs.sides[~broken], pairs.alike[~broken])
    # one point for each fan of triangles, numbered by the input's
    corners = triangles.ravel()
    following = np.arange(len(corners)).reshape(-1, 3)[:, [1, 2, 0]].ravel()
    one, other = whole.sides.T
    # where both run alike their starts are one point, else the start of one is the end of the other
    starts = np.where(whole.alike, other, following[other])
    ends = np.where(whole.alike, following[other], other)
    links = np.concatenate([np.stack([one, starts], 1), np.stack([following[one], ends], 1)])
    fan = components(len(corners), links)
    _, corner, point = np.unique(fan, return_index=True, return_inverse=True)
    by_source = np.lexsort((corner, corners[corner]))  # by the input's point
    rank = np.empty(len(by_source), np.int64)
    rank[by_source] = np.arange(len(by_source))
    moved, source = rank[point].reshape(-1, 3), corners[corner][by_source]
    return Sheets(
        triangles=moved,
        source=source,
        component=component,
        turned=turned,
        crowded_edges=crowded,
        one_sided_edges=int(broken.sum()),
    )


def _orientation(count: int, component: IntArray, pairs: _Pairs) -> tuple[BoolArray, BoolArray]:
    """Triangles (t,) to turn, and edges (e,) across which no turning makes them agree.

    Each triangle stands twice in a graph, as it is and turned; edges link the two that agree. A sheet turns those
    that its first triangle reaches turned. Sheets that reach both of one triangle are one-sided: there a spanning tree
    decides.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import breadth_first_order

    a, b = pairs.triangles.T
    other = np.where(pairs.alike, count, 0)
    links = np.concatenate([np.stack([a, b + other], 1), np.stack([a + count, b + count - other], 1)])
    reached = components(2 * count, links)
    first = np.zeros(int(component.max()) + 1, np.int64)
    first[component[::-1]] = np.arange(count)[::-1]
    turned = reached[count:] == reached[first][component]
    one_sided = reached[:count] == reached[count:]
    if one_sided.any():
        roots = np.unique(first[component[one_sided]])
        start = np.full(len(roots), count)  # one more triangle, beside every root: the tree reaches all sheets
        one, two = np.concatenate([a, start]).astype(np.int32), np.concatenate([b, roots]).astype(np.int32)
        value = np.concatenate([np.where(pairs.alike, 2, 1), np.ones_like(start)])
        graph = coo_array((value, (np.minimum(one, two), np.maximum(one, two))), shape=(count + 1, count + 1)).tocsr()
        graph = (graph + graph.T).tocsr()
        order, before = breadth_first_order(graph, count, directed=False)
        alike = np.asarray(graph[before[order[1:]], order[1:]]).ravel() == 2
        by_tree = [False] * (count + 1)
        for triangle, parent, flip in zip(order[1:].tolist(), before[order[1:]].tolist(), alike.tolist(), strict=True):
            by_tree[triangle] = by_tree[parent] ^ flip
        turned[one_sided] = np.array(by_tree[:count])[one_sided]
    return turned, (turned[a] ^ turned[b]) != pairs.alike
