"""Scanned surfaces as registration wants them: manifold, oriented outward, without junk; clouds with normals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.geometry.merged_points import merge_points
from facepipe.geometry.surface_sheets import Sheets, cut_sheets, outwardness

_THIN = 1e-10  # doubled area over the squared longest edge: below, a triangle has no normal
_TELLING = 0.02  # outwardness below which a sheet says nothing about its outside; a sphere's is 0.28


@dataclass(frozen=True, kw_only=True)
class SurfaceReport:
    """What was mended."""

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
    """A mended surface: each edge has one or two triangles, of one orientation, outward where shape tells."""

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
    are oriented alike within, and outward where their bulge tells; flat ones as most of their triangles were.

    :param points: (n, 3)
    :param triangles: (t, 3)
    :param smallest: share of the largest piece's area
    :raises InputError: nothing is left
    """
    first, place = merge_points(points)
    merged = np.asarray(points, dtype=np.float64)[first]
    corners = place[np.asarray(triangles, dtype=np.int64)]
    sound = _with_area(merged, corners)
    single = _not_repeated(corners[sound])
    corners = corners[sound][single]
    if not len(corners):
        raise InputError("surface", "no triangle with an area, expected a scanned surface")
    sheets = cut_sheets(corners)
    kept, small = _large(merged, corners, sheets.component, smallest)
    sheets = sheets if kept.all() else cut_sheets(corners[kept])  # what only junk kept apart joins again
    turned = sheets.turned ^ _inward(merged, sheets)
    oriented = np.where(turned[:, None], sheets.triangles[:, ::-1], sheets.triangles)
    piece = _by_area(merged[sheets.source], oriented, sheets.component)
    border = _border(oriented, len(sheets.source))
    report = SurfaceReport(
        merged_points=len(points) - len(first),
        flat_triangles=int((~sound).sum()),
        repeated_triangles=int((~single).sum()),
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


def _with_area(points: FloatArray, triangles: IntArray) -> BoolArray:
    a, b, c = points[triangles].transpose(1, 0, 2)
    doubled = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    longest = np.max([((b - a) ** 2).sum(axis=1), ((c - b) ** 2).sum(axis=1), ((a - c) ** 2).sum(axis=1)], axis=0)
    return np.asarray(doubled > _THIN * longest)


def _not_repeated(triangles: IntArray) -> BoolArray:
    """The first of triangles on the same three points."""
    rows = np.sort(triangles, axis=1)
    order = np.lexsort(rows.T[::-1])
    ordered = rows[order]
    keep = np.ones(len(rows), bool)
    keep[order[1:]] = (ordered[1:] != ordered[:-1]).any(axis=1)
    return keep


def _large(points: FloatArray, triangles: IntArray, piece: IntArray, smallest: float) -> tuple[BoolArray, int]:
    """Triangles of the pieces (t,) that are large enough, and the number of other pieces."""
    areas = np.bincount(piece, _areas(points, triangles))
    large = areas >= smallest * areas.max()
    return np.asarray(large[piece]), int((~large).sum())


def _used(numbers: IntArray) -> int:
    """How many different ones there are."""
    return int(np.count_nonzero(np.bincount(numbers.ravel())))


def _areas(points: FloatArray, triangles: IntArray) -> FloatArray:
    a, b, c = points[triangles].transpose(1, 0, 2)
    return np.asarray(np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2)


def _inward(points: FloatArray, sheets: Sheets) -> BoolArray:
    """Triangles (t,) of pieces that, turned as `sheets` tells, face inward or against what most of them did."""
    triangles = np.where(sheets.turned[:, None], sheets.triangles[:, ::-1], sheets.triangles)
    bulge = outwardness(points[sheets.source], triangles, sheets.component)
    mostly_turned = np.bincount(sheets.component, np.where(sheets.turned, 1.0, -1.0)) > 0
    inward = np.where(np.abs(bulge) >= _TELLING, bulge < 0, mostly_turned)
    return np.asarray(inward[sheets.component])


def _by_area(points: FloatArray, triangles: IntArray, component: IntArray) -> IntArray:
    """(m,) piece of every point, the largest 0."""
    order = np.argsort(-np.bincount(component, _areas(points, triangles)), kind="stable")
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    piece = np.zeros(len(points), np.int64)
    piece[triangles] = rank[component][:, None]
    return piece


def _border(triangles: IntArray, count: int) -> BoolArray:
    pairs = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, at, uses = np.unique(pairs[:, 0] * count + pairs[:, 1], return_index=True, return_counts=True)
    border = np.zeros(count, bool)
    border[pairs[at[uses == 1]]] = True
    return border
