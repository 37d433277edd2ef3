"""Where a face is looked for: what a file's joints say carries the head, all of a head, the tops of bodies, pieces."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.geometry.coarse_surface import Look, disc_look, grid_groups, surface_look
from facepipe.geometry.pinhole import Pinhole
from facepipe.geometry.polygons import point_areas
from facepipe.geometry.scan_surface import cloud_normals
from facepipe.geometry.vectors import group_sums, unit_vectors
from facepipe.scanning.clean_scan import CleanScan
from facepipe.scanning.landmarks.search import axis_views, side_views, sphere_views
from facepipe.scans import Scan

# Of groups and meshes that help to build, bind or collide with a body, and are no part of it: MakeHuman's base mesh
# (makehuman_base: helper-tights, joint-l-eye), and the collision hulls of Unreal's import and of Godot's.
_HELPERS = re.compile(r"^(?:helper-|joint-|u(?:cx|bx|cp|sp)_)|[-_]col(?:only)?$", re.IGNORECASE)
_MOST_POINTS = 300_000  # beyond, points of a cell of a grid are one
_THIN_CELLS = 700  # of that grid, over the longest side of the scan
_SMALL = 0.01  # of the largest piece's area: smaller ones are dropped, as of scans
_HEAD_PROPORTION = 1 / 3  # shortest side of a box about a head by the longest, at least; as in `rig.plausibility`
_TOPS = (0.16, 0.33)  # of the height of bodies: heads of grown people with some of the neck, and of drawn figures
_BESIDE = 0.75  # of such a top's height: how far from its middle line it reaches
_PIECES, _LEAST_SHARE = 4, 0.04  # pieces that are looked at alone, the largest, and their share of the area
_AT_ONCE = 12  # views from all around that are searched before the faces in them are looked at closely
_UPRIGHT = 0.97  # cosine: turned less than this from the file's axes, a body's own axes show nothing new


@dataclass(frozen=True, kw_only=True)
class Surface:
    """A mended scan to look at, no finer than a search needs."""

    look: Look
    component: IntArray  # (n,) connected piece of each point
    areas: FloatArray  # (n,) share of the surface at each point
    source: IntArray  # (n,) the point of the scan that each one is, or one that it stands for
    head: BoolArray | None  # (n,) what the joint of a head carries
    cloud: bool
    thinned: bool
    warnings: tuple[str, ...] = ()


def looked_at(scan: Scan, component: str | None = None) -> Surface:
    """The surface of a scan without helpers.

    :param component: name of the only mesh, object or group that counts
    :raises InputError: no such component, or no surface
    """
    scan, warnings = _chosen(scan, component)
    count = len(scan.points)
    head = None
    if scan.hints.head is not None and scan.hints.head.any():
        head = np.zeros(count, bool)
        head[scan.triangles[scan.hints.head]] = True
    stands_for: IntArray = np.arange(count)
    thinned = count > _MOST_POINTS
    if thinned:
        scan, stands_for = _thin(scan)
    cleaned = CleanScan(smallest=0.0)(scan)
    mended, source = cleaned.scan, stands_for[cleaned.source]
    if mended.is_cloud:
        assert mended.normals is not None  # of cleaned scans
        spacing = cloud_normals(mended.points, 6).spacing
        look = disc_look(mended.points, mended.normals, 1.2 * spacing, mended.colors)
        corners = len(look.points) // len(mended.points)
        source, found = np.repeat(source, corners), np.repeat(cleaned.component, corners)
        areas = np.repeat(spacing**2, corners)
    else:
        look, found = surface_look(mended.points, mended.triangles, mended.colors), cleaned.component
        areas = point_areas(look.points, look.triangles)
    return Surface(
        look=look,
        component=found,
        areas=areas,
        source=source,
        head=None if head is None else head[source],
        cloud=mended.is_cloud,
        thinned=thinned,
        warnings=warnings,
    )


def _chosen(scan: Scan, component: str | None) -> tuple[Scan, tuple[str, ...]]:
    """The scan without triangles that are not looked at, and a line about those."""
    hints, names = scan.hints, scan.hints.pieces
    if component is not None:
        if component not in names:
            listed = ", ".join(names[:8]) if names else "none"
            raise InputError(scan.name, f"no component '{component[:40]}', expected the name of one: {listed}")
        return _of_triangles(scan, hints.piece == names.index(component)), ()
    helpers = np.array([_HELPERS.search(name) is not None for name in names], bool)
    if not helpers.any():
        return scan, ()
    left_out = (hints.piece >= 0) & helpers[hints.piece]
    if left_out.all() or not left_out.any():
        return scan, ()
    example = names[int(hints.piece[np.argmax(left_out)])]
    return _of_triangles(scan, ~left_out), (f"{int(helpers.sum())} helper pieces are not looked at, such as {example}",)


def _of_triangles(scan: Scan, kept: BoolArray) -> Scan:
    texture = None if scan.texture is None else scan.texture.on_triangles(kept)
    return replace(scan, triangles=scan.triangles[kept], hints=scan.hints.on_triangles(kept), texture=texture)


def _thin(scan: Scan) -> tuple[Scan, IntArray]:
    """The scan with one point for each cell of a grid, and the first (n,) of those that each stands for."""
    cell = float(np.ptp(scan.points, axis=0).max()) / _THIN_CELLS
    group = grid_groups(scan.points, cell)
    first = np.unique(group, return_index=True)[1]
    count, share = len(first), 1.0 / np.bincount(group)[:, None]
    triangles = group[scan.triangles]
    a, b, c = triangles.T
    thin = Scan(
        name=scan.name,
        points=group_sums(group, scan.points, count) * share,
        triangles=triangles[(a != b) & (b != c) & (c != a)].astype(np.int32),
        normals=None if scan.normals is None else unit_vectors(group_sums(group, scan.normals, count)),
        colors=None if scan.colors is None else group_sums(group, scan.colors, count) * share,
    )
    return thin, first


@dataclass(frozen=True, kw_only=True)
class Place:
    """A part of a surface that is searched from some sides."""

    name: str
    points: BoolArray  # (n,) of the surface
    among: BoolArray  # (n,) of the pieces that it is a part of: what is around it is seen, other pieces are not
    views: Sequence[Pinhole]
    turns: int  # of crops in a picture's plane


def places(surface: Surface) -> Iterator[Iterable[Place]]:
    """What is searched, the likeliest first; of each list one place follows another until a face is found."""
    every = without_small(surface, np.ones(len(surface.component), bool))
    wholes = [("all of it", every, every)]
    if surface.head is not None:
        wholes.insert(0, ("what the joint of the head carries", without_small(surface, surface.head), every))
        yield [_around(surface, *wholes[0])]
    is_head, tops = _like_a_head(surface.look.points[every]), _tops(surface, every, "all of it", np.eye(3))
    whole = [_around(surface, *wholes[-1])]
    yield whole if is_head else chain(tops, whole)
    pieces = []
    for name, points, _ in wholes:
        pieces += [(f"a piece of {name}", points & one, one) for one in _pieces(surface, points)]
    for piece in pieces:
        own = [_around(surface, *piece)]
        is_body = not _like_a_head(surface.look.points[piece[1]])
        yield chain(_tops(surface, piece[1], piece[0], np.eye(3)), own) if is_body else own
    for name, points, among in (*wholes, *pieces):
        at = surface.look.points[points]
        if not _like_a_head(at):
            axes = _own_axes(surface, points)
            if np.abs(axes).max(axis=1).min() < _UPRIGHT:
                yield _tops(surface, points, name, axes)
        around = sphere_views(*_ball(at))
        yield [
            Place(name=name, points=points, among=among, views=around[start : start + _AT_ONCE], turns=6)
            for start in range(0, len(around), _AT_ONCE)
        ]
    if is_head:  # or a body that sits
        yield tops


def without_small(surface: Surface, points: BoolArray) -> BoolArray:
    """Those (n,) of `points` (n,) whose pieces have more than a little of the largest one's area among them."""
    areas = np.bincount(surface.component, surface.areas * points)
    kept: BoolArray = points & (areas >= _SMALL * areas.max())[surface.component]
    return kept


def _pieces(surface: Surface, points: BoolArray) -> list[BoolArray]:
    """The largest connected pieces among `points`, where there are several: one may hide the face of another."""
    areas = np.bincount(surface.component, surface.areas * points)
    large = np.argsort(-areas, kind="stable")[:_PIECES]
    large = large[areas[large] >= _LEAST_SHARE * areas.sum()]
    return [surface.component == one for one in large] if (areas > 0).sum() > 1 else []


def _like_a_head(points: FloatArray) -> bool:
    sides = np.ptp(points, axis=0)
    return bool(sides.min() >= _HEAD_PROPORTION * sides.max())


def _around(surface: Surface, name: str, points: BoolArray, among: BoolArray) -> Place:
    views = axis_views(*_ball(surface.look.points[points]))
    return Place(name=name, points=points, among=among, views=views, turns=4)


def _ball(points: FloatArray) -> tuple[FloatArray, float]:
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    return middle, float(np.linalg.norm(points - middle, axis=1).max())


def _own_axes(surface: Surface, points: BoolArray) -> FloatArray:
    """(3, 3) rows: the directions along which a surface is longest, second and third longest."""
    weights = surface.areas[points]
    at = surface.look.points[points] - np.average(surface.look.points[points], axis=0, weights=weights)
    return np.asarray(np.linalg.eigh(np.einsum("n,ni,nj->ij", weights, at, at))[1].T[::-1])


def _tops(surface: Surface, points: BoolArray, name: str, axes: FloatArray) -> Iterator[Place]:
    """The ends of a body, +Y and +Z of a file first, by the proportions of bodies, from all sides and upright.

    Arms that are held out are as long as a body is high: each end may be the head.
    """
    at = surface.look.points
    own = "XYZ" if np.array_equal(axes, np.eye(3)) else "123"
    for number, sign in ((1, 1), (2, 1), (1, -1), (2, -1), (0, 1), (0, -1)):
        upward, forward = sign * axes[number], axes[2 if number != 2 else 1]
        heights = at @ upward
        low, high = heights[points].min(), heights[points].max()
        across = at - heights[:, None] * upward
        for share in _TOPS:
            tall = share * (high - low)
            middle = np.median(across[points & (heights > high - tall / 2)], axis=0)
            near = np.linalg.norm(across - middle, axis=1) < _BESIDE * tall
            top = points & near & (heights > high - tall)
            if top.sum() < 3:
                continue
            views = side_views(*_ball(at[top]), upward, forward)
            called = f"the end of {name} along {'+' if sign > 0 else '-'}{own[number]}"
            yield Place(name=called, points=top, among=points, views=views, turns=1)
