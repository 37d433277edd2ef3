"""Soft region masks of a mesh from a map painted over its UV layout, one colour a region; masks made to sum to 1."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import BoolArray, ByteArray, FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.geometry.factor import factorise
from facepipe.geometry.options import FIRST_TILE, MapSampling
from facepipe.geometry.polygons import components, distinct_edges

_SUM_ROUNDING = 1e-5  # sums of masks closer to 1 than this were 1 before they were stored
_SHORTEST_EDGE = 1e-6  # of the mean edge: shorter edges count as this long
_MOST_TAPS = 8  # lookups a side of a footprint, at most
_UV_SLACK = 1e-6  # in UV: what exporters leave of an exact 0 or 1

UNKNOWN = -1
_OPAQUE_ALPHA = 128  # alpha from here on: painted
_SUM_WEIGHT = 1e4  # how much heavier than a colour level the sum of a mix weighs


def normalise_masks(masks: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The masks (R, n) of R regions so that none sums above 1, and the rest (n,) of points that sum below 1.

    Masks, each 0 or more, and rest sum to 1: the rest is the share of a point that belongs to no region.
    """
    masks = np.asarray(masks, np.float64)
    largest = np.maximum(masks.max(axis=0, initial=0.0), 1.0)
    sums = (masks / largest).sum(axis=0) * largest
    rest = np.where(sums < 1.0 - _SUM_ROUNDING, 1.0 - sums, 0.0)
    normalised = masks / largest / np.where(rest > 0, 1.0, np.where(sums > 0, sums / largest, 1.0))
    return normalised, rest


def smooth_masks(masks: FloatArray, points: FloatArray, edges: IntArray, width: float) -> FloatArray:
    """Masks (R, n) with a harmonic transition of `width` (units of `points`) across the borders between regions.

    A border crosses every edge whose end points have different largest regions. Points nearer to one than half the
    width, along the edges (e, 2), take the solution of the discrete Laplace equation ``sum_j (m_i - m_j) / l_ij = 0``
    over edges of length l; all others keep their masks exactly. The weights are above 0, so that the maximum principle
    holds: smoothed masks lie between those around the band, and sum to 1 where those do. Free points that no edges join
    to a point outside the band keep their masks.

    :param width: 0 or more; 0 changes nothing
    """
    smoothed = np.array(masks, dtype=np.float64)
    pairs, *_ = distinct_edges(np.asarray(edges).reshape(-1, 2))
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    if width == 0 or not len(pairs) or not len(smoothed):
        return smoothed
    lengths = np.linalg.norm(np.asarray(points, np.float64)[pairs[:, 0]] - np.asarray(points)[pairs[:, 1]], axis=1)
    lengths = np.maximum(lengths, max(_SHORTEST_EDGE * float(lengths.mean()), np.finfo(np.float64).tiny))
    # a piece without a held point has the constants as the kernel of its Laplacian: no factor
    # (n,) distance along the edges to the nearest border, which crosses an edge where two regions are equal
    from scipy.sparse import coo_array, diags_array
    from scipy.sparse.csgraph import dijkstra

    count = smoothed.shape[1]
    with_rest = np.concatenate([smoothed, 1.0 - smoothed.sum(axis=0, keepdims=True)])
    region = with_rest.argmax(axis=0)
    crossing = region[pairs[:, 0]] != region[pairs[:, 1]]
    start, end = pairs[crossing].T
    lead = with_rest[region[start], start] - with_rest[region[end], start]
    lag = with_rest[region[end], end] - with_rest[region[start], end]
    share = lead / np.where(lead + lag > 0, lead + lag, 1.0)
    seeds = np.full(count, np.inf)
    np.minimum.at(seeds, start, share * lengths[crossing])
    np.minimum.at(seeds, end, (1.0 - share) * lengths[crossing])
    seeded = np.flatnonzero(np.isfinite(seeds))
    tiny = np.finfo(np.float64).tiny  # csgraph takes a length of 0 for no edge
    rows = np.concatenate([pairs[:, 0], np.full(len(seeded), count)]).astype(np.int32)
    columns = np.concatenate([pairs[:, 1], seeded]).astype(np.int32)
    values = np.concatenate([lengths, np.maximum(seeds[seeded], tiny)])
    graph = coo_array((values, (rows, columns)), shape=(count + 1, count + 1)).tocsr()
    free = np.asarray(dijkstra(graph, directed=False, indices=count))[:count] < width / 2
    # the free points (n,) of components that also have points that are not free
    component = components(len(free), pairs)
    held = np.zeros(int(component.max()) + 1, dtype=np.bool_)
    held[component[~free]] = True
    free = np.asarray(free & held[component])
    if free.any():
        rows, columns = np.concatenate([pairs, pairs[:, ::-1]]).T
        adjacency = coo_array((np.tile(1.0 / lengths, 2), (rows, columns)), shape=(count, count)).tocsr()[free]
        laplacian = diags_array(adjacency.sum(axis=1)) - adjacency[:, free]
        right = np.ascontiguousarray(adjacency[:, ~free] @ smoothed[:, ~free].T)
        smoothed[:, free] = np.clip(factorise(laplacian).solve(right).T, 0.0, 1.0)
    return smoothed


class RegionMasks(NamedTuple):
    """Masks (n, k), rows of sum 1 or 0, and the points (n,) that the map covers: those of sum 1."""

    masks: FloatArray
    covered: BoolArray


def region_masks(
    image: ByteArray,
    colors: ByteArray,
    uv: FloatArray,
    face_vertex_counts: IntArray,
    face_vertex_indices: IntArray,
    point_count: int,
    sampling: MapSampling,
    *,
    background: ByteArray | None = None,
    where: str = "region map",
) -> RegionMasks:
    """Masks of the regions whose colours a map shows at the points of a mesh.

    A corner takes the texel that its UV lies in, v up: column ``floor(u w)``, row ``floor((1 - v) h)``; or the mean
    over a footprint of texels around it. `texel_shares` gives what a texel counts for. Corners belong to the tile in
    which the middle of their face lies. A point takes the mean over its corners, those in other tiles or on unpainted
    texels left out; one without any corner left is not covered.

    :param image: (h, w, 3|4) RGB or RGBA, top row first; alpha below 128 is unpainted
    :param colors: (k, 3) one colour per mask, all different
    :param uv: (corners, 2) texture coordinates
    :param face_vertex_counts: (faces,) corners of each face
    :param face_vertex_indices: (corners,) the corner's point
    :param background: (3,) a colour that is unpainted
    :param where: the trail to the map for messages
    :raises InputError: a colour that the legend lacks
    """
    palette = Palette(colors=colors, background=background, tolerance=sampling.tolerance, edge=sampling.edge)
    uv, counts, tile = np.asarray(uv, dtype=np.float64), face_vertex_counts, sampling.tile
    # the middle of a face decides which tile its corners belong to: those on the line between two tiles lie in either
    face = np.repeat(np.arange(len(counts)), counts)
    sums = np.stack([np.bincount(face, axis, minlength=len(counts)) for axis in uv.T], axis=1)
    corner = np.floor(sums / np.maximum(counts, 1)[:, None])[face]
    place, inside = uv - corner, np.ones(len(uv), dtype=bool)
    if tile is None:
        unit = np.asarray(((place >= 0) & (place <= 1)).all(axis=1))
        place = np.where(unit[:, None], place, uv - np.floor(uv))
    else:
        row, column = divmod(tile - FIRST_TILE, 10)
        on_it = (corner == (column, row)) & (place >= -_UV_SLACK) & (place <= 1 + _UV_SLACK)
        place, inside = np.clip(place, 0.0, 1.0), np.asarray(on_it.all(axis=1))
    points = np.asarray(face_vertex_indices)[inside]
    lookup = _Lookup(image, palette)
    shares = lookup.sample(place[inside], sampling.footprint)
    if lookup.unknown:
        raise _unknown_color(where, image, palette, lookup, points)
    # + 0.0: of no corners bincount gives integers, in spite of its weights
    summed = np.stack([np.bincount(points, column, minlength=point_count) for column in shares.T], axis=1) + 0.0
    total = summed.sum(axis=1, keepdims=True)
    return RegionMasks(np.divide(summed, total, out=np.zeros_like(summed), where=total > 0), total[:, 0] > 0)


class _Lookup:
    """A map being sampled; remembers the texels of unknown colour and the UVs that hit them."""

    def __init__(self, image: ByteArray, palette: Palette) -> None:
        self.image, self.palette = image, palette
        self.unknown: list[tuple[IntArray, IntArray]] = []  # (texels, rows of the UVs), parallel

    def sample(self, place: FloatArray, footprint: int) -> FloatArray:
        """(m, k) shares at (m, 2) places in 0..1: rows of sum 1, or 0 where nothing is painted."""
        height, width = self.image.shape[:2]
        column, row = place[:, 0] * width, (1.0 - place[:, 1]) * height
        shares = np.zeros((len(place), len(self.palette.colors)))
        # no more than 8 lookups a side: a footprint of 256 texels would take 65,536 of each corner
        taps = min(footprint, _MOST_TAPS)
        offsets = (np.arange(taps) + 0.5) / taps * footprint - footprint / 2
        for down in offsets if len(place) else ():
            for right in offsets:
                x = np.clip(np.floor(column + right), 0, width - 1).astype(np.int64)
                y = np.clip(np.floor(row + down), 0, height - 1).astype(np.int64)
                texels = y * width + x
                distinct, back = np.unique(texels, return_inverse=True)
                found, unknown = texel_shares(self.image, distinct, self.palette)
                if unknown.any():
                    rows = np.flatnonzero(unknown[back.ravel()])
                    self.unknown.append((texels[rows], rows))
                shares += found[back.ravel()]
        total = shares.sum(axis=1, keepdims=True)
        return np.asarray(np.divide(shares, total, out=shares, where=total > 0))


def _unknown_color(where: str, image: ByteArray, palette: Palette, lookup: _Lookup, points: IntArray) -> InputError:
    """The colour that hits the most points, with how many, where, and the nearest that the legend has."""
    texels, rows = (np.concatenate(group) for group in zip(*lookup.unknown, strict=True))
    colors, of_hit = np.unique(image.reshape(-1, image.shape[2])[texels, :3], axis=0, return_inverse=True)
    pairs = np.unique(np.stack([of_hit.ravel(), points[rows]]), axis=1)
    hits = np.bincount(pairs[0], minlength=len(colors))
    worst = int(hits.argmax())
    y, x = divmod(int(texels[of_hit.ravel() == worst].min()), image.shape[1])
    distance = np.linalg.norm(palette.colors.astype(np.float64) - colors[worst], axis=1)
    nearest = int(distance.argmin())
    more = f" ({len(colors)} such colours at {len(np.unique(pairs[1]))} points in all)" if len(colors) > 1 else ""
    return InputError(
        f"{where} -> texel {x}, {y}",
        f"colour {hex_color(colors[worst])} at {hits[worst]} points{more}, expected one of the legend: the nearest, "
        f"{hex_color(palette.colors[nearest])}, is {distance[nearest]:.0f} away, the tolerance {palette.tolerance:g}",
    )


def hex_color(color: npt.ArrayLike) -> str:
    """``#rrggbb`` of three numbers 0..255."""
    return "#" + "".join(f"{int(channel):02x}" for channel in np.asarray(color)[:3])


@dataclass(frozen=True, kw_only=True)
class Palette:
    """The colours of a map and how loosely they are meant."""

    colors: ByteArray  # (k, 3), all different
    background: ByteArray | None = None  # (3,) colour of unpainted texels, beside transparent ones
    tolerance: float  # distance in RGB, 0..255 a channel
    edge: int  # texels over which a painted border may run

    @cached_property
    def known(self) -> FloatArray:
        """(k or k + 1, 3) the colours, then the background."""
        rows = [self.colors.reshape(-1, 3), *([] if self.background is None else [self.background.reshape(1, 3)])]
        return np.concatenate(rows).astype(np.float64)

    def labels(self, texels: ByteArray) -> tuple[IntArray, BoolArray]:
        """(m,) nearest colours within the tolerance of (m, 3|4) texels, k for unpainted or UNKNOWN; which are exact."""
        packed = texels.astype(np.uint32) @ (1 << 8 * np.arange(texels.shape[1], dtype=np.uint32))
        _, first, back = np.unique(packed, return_index=True, return_inverse=True)
        values = texels[first]
        distance = np.linalg.norm(values[:, None, :3].astype(np.float64) - self.known, axis=2)
        label, least = distance.argmin(axis=1), distance.min(axis=1)
        label[least > self.tolerance] = UNKNOWN
        if texels.shape[1] == 4:
            label[values[:, 3] < _OPAQUE_ALPHA] = len(self.colors)
            least[values[:, 3] < _OPAQUE_ALPHA] = 0.0
        return label[back.ravel()], (least == 0)[back.ravel()]


def texel_shares(image: ByteArray, texels: IntArray, palette: Palette) -> tuple[FloatArray, BoolArray]:
    """The regions that some texels of `image` (h, w, 3|4) stand for.

    A colour of the palette is that one. Another is the nearest within the tolerance; but where that one is not found
    at most `edge` texels away, and a mix of those that are is within the tolerance, it is the mix, as antialiasing
    makes it, and counts by its shares. A colour that is neither near one of the palette nor a mix is unknown. An
    unpainted texel takes the nearest painted ones at most `edge` texels away.

    :param texels: (m,) numbers ``row * w + column``
    :returns: (m, k) shares of the k colours, rows of sum 1 or all 0 (unpainted), and which are unknown (m,)
    """
    pixels, count = image.reshape(-1, image.shape[2]), len(palette.colors)
    label, exact = palette.labels(pixels[texels])
    shares = np.where(label[:, None] == UNKNOWN, 0.0, np.eye(count + 1)[label])
    unsure = np.flatnonzero(~exact | (label == count))
    if len(unsure) and palette.edge:
        # the square of 2 edge + 1 texels around each, clamped to the image, and squared distances
        edge, (height, width) = palette.edge, image.shape[:2]
        row, column = np.divmod(texels[unsure], width)
        down, right = (axis.ravel() for axis in np.mgrid[-edge : edge + 1, -edge : edge + 1])
        rows = np.clip(row[:, None] + down, 0, height - 1)
        columns = np.clip(column[:, None] + right, 0, width - 1)
        around, distance = rows * width + columns, (rows - row[:, None]) ** 2 + (columns - column[:, None]) ** 2
        distinct, back = np.unique(around, return_inverse=True)
        labels, pure = palette.labels(pixels[distinct])
        near, sure = labels[back.reshape(around.shape)], pure[back.reshape(around.shape)]
        # halfway from red to blue lies purple: by the nearest colour alone the border would be a third region
        shares[unsure] = _settled(pixels[texels[unsure], :3], label[unsure], exact[unsure], near, sure, palette)
        # maps often end where the UV island ends, and corners lie on its border
        bare = shares[unsure, count] >= 1
        near, far = near[bare], np.iinfo(np.int64).max
        distance = np.where((near >= 0) & (near < count), distance[bare], far)
        least = distance.min(axis=1, keepdims=True)
        closest = (distance == least) & (least < far)
        found = np.stack([(closest & (near == number)).sum(axis=1) for number in range(count)], axis=1)
        shares[unsure[bare], :count] = found / np.maximum(found.sum(axis=1, keepdims=True), 1.0)
    unknown = shares.sum(axis=1) <= 0
    painted = shares[:, :count]
    total = painted.sum(axis=1, keepdims=True)
    return np.divide(painted, total, out=np.zeros_like(painted), where=total > 0), unknown


def _settled(
    colors: ByteArray, label: IntArray, exact: BoolArray, near: IntArray, sure: BoolArray, palette: Palette
) -> FloatArray:
    """Shares (m, k + 1) of the palette's colours and the unpainted; rows of 0 are unknown.

    :param label: (m,) as `Palette.labels` gives it, and `exact` (m,)
    :param near: (m, s) labels around, and which are exact: `sure` (m, s)
    """
    known = label != UNKNOWN
    shares = np.where(known[:, None], np.eye(len(palette.colors) + 1)[label], 0.0)
    seen = ((near == label[:, None]) & sure).any(axis=1) & known
    for choice in (np.where(sure, near, UNKNOWN), near):  # pure colours around, then those about right
        open_ = np.flatnonzero(~exact & ~seen)
        mixed = _mixes(colors[open_], choice[open_], palette)
        found = mixed.any(axis=1)
        shares[open_[found]] = mixed[found]
        seen[open_[found]] = True
        seen |= known  # the nearest colour goes before a mix of what is only about right
    return shares


def _mixes(colors: ByteArray, near: IntArray, palette: Palette) -> FloatArray:
    """Shares (m, k + 1) of the palette's colours and the background in `colors` (m, 3); rows of 0 are no mix.

    :param near: (m, s) labels around each; only these colours can be mixed
    """
    from scipy.optimize import nnls

    around = np.stack([(near == number).any(axis=1) for number in range(len(palette.known))], axis=1)
    cases, back = np.unique(np.column_stack([colors, around]), axis=0, return_inverse=True)
    shares = np.zeros((len(cases), len(palette.colors) + 1))
    for number, case in enumerate(cases):
        color, choice = case[:3], np.flatnonzero(case[3:])
        if len(choice):
            known = palette.known[choice]
            system = np.vstack([known.T, np.full(len(choice), _SUM_WEIGHT)])
            parts, _ = nnls(system, np.append(color.astype(np.float64), _SUM_WEIGHT))
            if np.linalg.norm(parts @ known - color) <= palette.tolerance:
                shares[number, choice] = parts
    return shares[back.ravel()]
