"""Blinks from a head's own eyes: its lids closed column by column, and slid over its own eyeball.

Seen from the middle of the eyeball, skin covers every direction but the aperture. That hole is found whatever the mesh
is like: lids with a rim, eye bags behind them, or a border at the margin. Directions are a `column`, the angle off the
plane across the line from corner to corner, and a `turn` about that line: a lid that closes keeps its column.

Carried shapes alone leave gaps of 0.6 to 5 mm, as apertures differ more than faces do.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.geometry.balls import RadialSurface
from facepipe.geometry.contacts import STEP, Grid
from facepipe.geometry.geodesics import graph_distances, surface_graph
from facepipe.geometry.polygons import flipped_triangles, triangle_normals
from facepipe.scanning.transfer.unfold import unfolded
from facepipe.verbs.skin.surface import smoothstep

SHUT, PAINT, NO_SOCKET = "eyes are shut", "eyes are paint", "no lids around the eye"
EYES = {"Left": slice(42, 48), "Right": slice(36, 42)}  # landmarks of multipie68
WAYS = (0.25, 0.5, 0.75)  # weights of inbetweens
_SHUT_SHARE = 0.21  # of an eye's width, that lids' landmarks are apart; those found on shut eyes of a scan are 0.2
_CELL = 0.004  # radians: 0.05 mm on an eyeball
_WINDOW = np.array([1.15, 1.25])  # radians of column and turn, to each side of the aperture's middle
_NARROWEST, _LOWEST = 0.4, 0.03  # of the eye's width, of an aperture
_INSIDE = 0.85  # of the radius: what lies deeper is the socket, which eyeballs come through
_FAR = 1.75  # and what lies farther off is no lid: the nose covers the inner corner
_WIDTH = 30.0  # mm, of the eye that lengths below are of
_NEAR = 60.0  # mm from the eyeball's middle: skin that a blink may move
_FOLLOWS = {1: (0.5, 8.5), -1: (0.5, 14.0)}  # mm along the skin from its margin: lids go with it up to, not beyond
_RISE = (0.0, 0.35)  # of the way, that the lower lid meets the upper one
_USUAL_RISE = 0.12
_AT_MARGIN = 0.045  # radians from the hole: of a coarse lid whose layers cross, no point lies on its outline
_CANTHUS = 0.3  # radians from a corner, where margins start to meet halfway: shear there would turn triangles over
_CORNER = 0.1  # radians beyond a corner, over which the motion of margins fades
_BENT = 5  # columns
_END = 0.03  # radians from a corner, where margins meet anyway
_RIM_MM = 1.2  # along the skin from the margin: a lid's rim
_STEP_MM = 0.5  # from one closed lid to the other, from before
_OVER_MM = 0.03  # that the upper margin goes below the lower
_SETTLED_MM, _ROUNDS = 0.02, 4  # of gaps that edges leave between points
_MOST_MORE_MM = 0.5  # that the upper margin goes lower for them
_NARROW = 0.35  # of the opening: corners, where margins may give way so that nothing turns over
_OPEN_MM = 0.35  # of gaps, that points which don't turn over may cost
_OUTLINE = 0.012  # radians from the hole, up to which points are its outline
_SETTLES = 4
_TOUCH_MM = 0.05  # of skin in the eyeball, that counts as on it
_SLIDES_MM = 0.2  # shapes that move lids less leave them where they are


@dataclass(frozen=True, kw_only=True)
class Globe:
    """What lids slide over."""

    centre: FloatArray  # (3,)
    radius: float
    surface: RadialSurface | None = None  # of the head's own eyeball; None: it has none

    def heights(self, points: FloatArray) -> FloatArray:
        """(m,) how far points (m, 3) lie over it, below 0 inside."""
        offsets = points - self.centre
        return np.asarray(np.linalg.norm(offsets, axis=1) - self.reach(offsets))

    def reach(self, directions: FloatArray) -> FloatArray:
        """(m,) how far it reaches from its centre along directions (m, 3) of any length."""
        if self.surface is None:
            return np.full(len(directions), self.radius)
        lengths = np.linalg.norm(directions, axis=1, keepdims=True)
        inner = 0.5 * self.radius  # a place surely inside: its depth and where it lies are the radius there
        places = self.centre + inner * directions / np.where(lengths > 0, lengths, 1.0)
        return np.asarray(self.surface.depths(places) + inner)


@dataclass(frozen=True, kw_only=True)
class Aperture:
    """The opening between the lids of an eye, of a skin with n points."""

    globe: Globe
    axes: FloatArray  # (3, 3) rows: along the eye, up, outwards
    width: float  # mm
    columns: FloatArray  # (c,) radians, even, from corner to corner
    upper: FloatArray  # (c,) turn of the upper margin
    lower: FloatArray  # (c,)
    near: IntArray  # (k,) points of the skin around
    side: IntArray  # (k,) 1 above, -1 below
    distance: FloatArray  # (k,) mm along the skin from the margin of the side

    def polar(self, points: FloatArray) -> FloatArray:
        """(m, 3) column, turn, and height over the globe of points."""
        offsets = (points - self.globe.centre) @ self.axes.T
        lengths = np.maximum(np.linalg.norm(offsets, axis=1), 1e-9)
        columns = np.arcsin(np.clip(offsets[:, 0] / lengths, -1.0, 1.0))
        turns = np.arctan2(offsets[:, 1], offsets[:, 2])
        return np.stack([columns, turns, lengths - self.globe.reach(points - self.globe.centre)], axis=1)

    def places(self, polar: FloatArray) -> FloatArray:
        """The points of column, turn and height."""
        across, (sine, cosine) = np.cos(polar[:, 0]), (np.sin(polar[:, 1]), np.cos(polar[:, 1]))
        directions = np.stack([np.sin(polar[:, 0]), across * sine, across * cosine], axis=1) @ self.axes
        return np.asarray(self.globe.centre + (self.globe.reach(directions) + polar[:, 2])[:, None] * directions)


@dataclass(frozen=True, kw_only=True)
class LidFigures:
    """How lids close, in millimetres."""

    gap_mean: float  # from corner to corner
    gap_most: float
    in_ball: float  # the deepest that skin which is seen in the neutral lies in the eyeball
    in_ball_neutral: float  # and how deep at rest
    lid_flips: int  # triangles of the lids, seen in the neutral, that turn over


@dataclass(frozen=True, kw_only=True)
class Blink:
    """A blink of n points of skin."""

    delta: FloatArray  # (n, 3) mm
    inbetweens: Mapping[float, FloatArray]  # weight -> (n, 3) mm


def eye_frame(landmarks: FloatArray, side: str) -> tuple[FloatArray, FloatArray, float]:
    """The middle of an eye's landmarks, (3, 3) rows along it, up and outwards, and its width.

    :param landmarks: (68, 3)
    """
    marks = landmarks[EYES[side]]
    along = marks[3] - marks[0]
    up = landmarks[17:27].mean(axis=0) - landmarks[6:11].mean(axis=0)
    width = float(np.linalg.norm(along))
    along = along / max(width, 1e-9)
    up = up - (up @ along) * along
    up /= max(np.linalg.norm(up), 1e-9)
    return marks.mean(axis=0), np.stack([along, up, np.cross(along, up)]), width


def aperture_of(
    points: FloatArray, triangles: IntArray, landmarks: FloatArray, side: str, globe: Globe
) -> Aperture | str:
    """The aperture of an eye, or why it has none.

    :param points: (n, 3) mm, of the skin, cuts sewn
    :param triangles: (t, 3) oriented outward
    :param landmarks: (68, 3) mm
    :param side: Left or Right
    :param globe: the head's own eyeball, or where the fitted template's lies
    """
    middle, frame, width = eye_frame(landmarks, side)
    marks = landmarks[EYES[side]]
    apart = np.linalg.norm(marks[[1, 2]] - marks[[5, 4]], axis=1).mean()
    # about the line from corner to corner, with the aperture's middle straight ahead
    ahead = middle - globe.centre
    ahead -= (ahead @ frame[0]) * frame[0]
    ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-9)
    axes = np.stack([frame[0], np.cross(ahead, frame[0]), ahead])
    found = _Directions.of(points, triangles, globe, axes)
    hole = found.hole((middle - globe.centre) @ axes.T, marks, globe, axes)
    if hole is None or np.ptp(np.flatnonzero(hole.any(axis=0))) * _CELL * globe.radius < _NARROWEST * width:
        return SHUT if apart < _SHUT_SHARE * width else PAINT
    if hole[[0, -1]].any() or hole[:, [0, -1]].any():
        return NO_SOCKET
    tall = hole.sum(axis=0).max() * _CELL * globe.radius
    # eyes that landmarks show shut may be narrow; a hole much taller than those are apart is none between lids
    if tall < _LOWEST * width or (apart < _SHUT_SHARE * width and tall > 2.0 * apart):
        return SHUT
    inside = np.flatnonzero(hole.any(axis=0))
    rows, high = np.arange(len(hole))[:, None], hole[:, inside]
    top = np.where(high, rows, -1).max(axis=0)
    bottom = np.where(high, rows, len(hole)).min(axis=0)
    columns, upper, lower = found.at(inside, 0), found.at(top, 1) + _CELL / 2, found.at(bottom, 1) - _CELL / 2
    near, lid, distance = _lids(found, points, triangles, hole, (columns, upper, lower), globe)
    return Aperture(
        globe=globe, axes=axes, width=width, columns=columns, upper=upper, lower=lower, near=near, side=lid,
        distance=distance,
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class _Directions:
    """What skin covers which directions from the middle of an eye, on a grid."""

    places: FloatArray  # (n, 2) column and turn of the skin's points
    low: FloatArray  # (2,) of the grid's first cell
    depth: FloatArray  # (rows, columns) mm to the outermost skin, minus infinity where there is none
    front: BoolArray  # (n,) points that are drawn

    @classmethod
    def of(
        cls, points: FloatArray, triangles: IntArray, globe: Globe, axes: FloatArray, window: FloatArray | None = None
    ) -> _Directions:
        """:param window: (2, 2) lowest and highest column and turn; default the half before the eye"""
        offsets = (points - globe.centre) @ axes.T
        lengths = np.linalg.norm(offsets, axis=1)
        ahead = offsets[:, 2] > 0.05 * globe.radius
        reaches = lengths[triangles]
        kept = triangles[
            ahead[triangles].all(axis=1)
            & (reaches.max(axis=1) > _INSIDE * globe.radius)
            & (reaches.min(axis=1) < _FAR * globe.radius)
        ]
        columns = np.arcsin(np.clip(offsets[:, 0] / np.maximum(lengths, 1e-9), -1.0, 1.0))
        places = np.stack([columns, np.arctan2(offsets[:, 1], offsets[:, 2])], axis=1)
        low, high = np.stack([-_WINDOW, _WINDOW]) if window is None else window
        size = np.ceil((high - low) / _CELL).astype(np.int64) + 1
        flat = np.column_stack([(places - low) * (STEP / _CELL), lengths])
        grid = Grid(flat, np.zeros(2, np.int64), (int(size[0]), int(size[1])))
        front = np.zeros(len(points), bool)
        front[kept.ravel()] = True
        return cls(places=places, low=low, depth=grid.first(kept)[0].reshape(size[1], size[0]), front=front)

    def at(self, cells: IntArray, axis: int) -> FloatArray:
        """Column (axis 0) or turn (1) of cells."""
        return np.asarray(self.low[axis] + cells * _CELL)

    def hole(self, middle: FloatArray, marks: FloatArray, globe: Globe, axes: FloatArray) -> BoolArray | None:
        """(rows, columns) the largest uncovered patch that lies between the landmarks (6, 3) of the lids."""
        from scipy.ndimage import label

        numbers, count = label(~np.isfinite(self.depth))
        offsets = (marks - globe.centre) @ axes.T
        columns = np.arcsin(offsets[:, 0] / np.linalg.norm(offsets, axis=1))
        turns = np.arctan2(offsets[:, 1], offsets[:, 2])
        cells = ((np.stack([columns, turns], axis=1) - self.low) / _CELL).astype(np.int64)
        low, high = np.maximum(cells.min(axis=0), 0), np.maximum(cells.max(axis=0) + 1, 0)
        inside = numbers[low[1] : high[1], low[0] : high[0]]
        sizes = np.bincount(inside.ravel(), minlength=count + 1)
        sizes[0] = 0
        return numbers == sizes.argmax() if sizes.max(initial=0) else None


def _lids(
    found: _Directions,
    points: FloatArray,
    triangles: IntArray,
    hole: BoolArray,
    margins: tuple[FloatArray, FloatArray, FloatArray],
    globe: Globe,
) -> tuple[IntArray, IntArray, FloatArray]:
    """Points of the skin around an aperture, the lid of each (1 or -1), and how far along the skin its margin is."""
    from scipy.ndimage import binary_dilation

    rim = binary_dilation(hole, np.ones((3, 3)), iterations=round(_AT_MARGIN / _CELL))
    cells = np.floor((found.places - found.low) / _CELL + 0.5).astype(np.int64)
    lengths = np.linalg.norm(points - globe.centre, axis=1)
    there = (
        found.front
        & (lengths < _FAR * globe.radius)
        & (cells >= 0).all(axis=1)
        & (cells < [rim.shape[1], rim.shape[0]]).all(axis=1)
    )
    seeds = np.flatnonzero(there)
    seeds = seeds[rim[cells[seeds, 1], cells[seeds, 0]]]
    columns, upper, lower = margins
    # by the middle line of where the aperture is wide: at its very ends, edges of the hole decide which is which
    line = np.polynomial.Polynomial.fit(columns, (upper + lower) / 2, 2, w=upper - lower + 1e-6)
    between = line(np.clip(found.places[seeds, 0], columns[0], columns[-1]))
    above = found.places[seeds, 1] > between
    middle = points[seeds].mean(axis=0) if len(seeds) else points.mean(axis=0)
    around = np.linalg.norm(points - middle, axis=1) < _NEAR
    near = np.flatnonzero(around)
    place = np.full(len(points), -1)
    place[near] = np.arange(len(near))
    kept = triangles[around[triangles].all(axis=1)]
    graph = surface_graph(points[near], np.pad(place[kept], ((0, 0), (0, 1)), constant_values=-1))
    away = graph_distances(graph, [place[seeds[above]], place[seeds[~above]]])
    return near, np.where(away[0] <= away[1], 1, -1), away.min(axis=0)


def _smooth(values: FloatArray, cells: int) -> FloatArray:
    """A running mean over 2 `cells` + 1, the ends repeated."""
    window = np.ones(2 * cells + 1) / (2 * cells + 1)
    return np.convolve(np.pad(values, cells, mode="edge"), window, mode="valid")


def closed(points: FloatArray, triangles: IntArray, eye: Aperture, carried: FloatArray) -> Blink:
    """The blink of an eye, of what the template brought and what its own lids need.

    :param points: (n, 3) mm, as those that the aperture was found on
    :param triangles: (t, 3)
    :param carried: (n, 3) mm, the template's blink
    """
    near, start = eye.near, points[eye.near]
    before = eye.polar(start)
    low, high = np.where(eye.side > 0, *(np.array(_reach(eye, side))[:, None] for side in (1, -1)))
    follow = 1.0 - smoothstep((eye.distance - low) / (high - low))
    lines, floor = _meeting(points, eye, before, carried), _floor(before[:, 2])
    ended, more = points + carried, np.zeros_like(eye.columns)
    for _ in range(_ROUNDS):
        slid = eye.places(lines.goal(eye, before, more))
        ended[near] = _lifted(eye, start + carried[near] + follow[:, None] * (slid - start - carried[near]), floor)
        gaps = _gaps(ended, triangles, eye)
        if gaps.max(initial=0.0) <= _SETTLED_MM:
            break
        missing = lines.ends * _pooled(gaps, eye, start, triangles)
        more = np.minimum(more + missing / eye.globe.radius, _MOST_MORE_MM / eye.globe.radius)
    delta = _settled(points, ended, triangles, eye, float(gaps.max(initial=0.0))) - points
    after = eye.polar(start + delta[near])
    inbetweens = {}
    for share in WAYS:
        arc, chord = eye.places(before + share * (after - before)), start + share * delta[near]
        whole = share * delta
        whole[near] = _lifted(eye, chord + follow[:, None] * (arc - chord), floor) - start
        inbetweens[share] = whole
    return Blink(delta=delta, inbetweens=inbetweens)


@dataclass(frozen=True, kw_only=True)
class _Meeting:
    """Where the lids of an eye meet, for c columns."""

    line: FloatArray  # (c,) turn
    ways: FloatArray  # (2, c) radians that the upper and the lower margin go there
    excess: FloatArray  # (c,) mm that both lids give way, of rims that would meet one before the other
    ends: FloatArray  # (c,) 0 at the corners, where margins meet anyway, else 1

    def goal(self, eye: Aperture, before: FloatArray, more: FloatArray) -> FloatArray:
        """(k, 3) column, turn and height of lids that have closed.

        :param before: (k, 3) of open ones
        :param more: (c,) radians that the upper margin goes lower than it should have to
        """

        def at(values: FloatArray) -> FloatArray:
            return np.interp(before[:, 0], eye.columns, values)

        upper, goal = eye.side > 0, before.copy()
        beyond = np.maximum(eye.columns[0] - before[:, 0], before[:, 0] - eye.columns[-1])
        fade = 1.0 - smoothstep(beyond / _CORNER)
        goal[:, 1] += fade * np.where(upper, at(self.ways[0] - more), at(self.ways[1]))
        # no margin passes the line by more than it must, as points off the hole's outline would
        line, deeper = at(self.line), at(self.ends * _OVER_MM / eye.globe.radius + more)
        least, most = np.minimum(line - deeper, before[:, 1]), np.maximum(line, before[:, 1])
        goal[:, 1] = np.where(upper, np.maximum(goal[:, 1], least), np.minimum(goal[:, 1], most))
        goal[:, 2] += fade * np.where(upper, -1.0, 1.0) * at(self.excess)
        return goal


def _meeting(points: FloatArray, eye: Aperture, before: FloatArray, carried: FloatArray) -> _Meeting:
    """The lower margin, raised as the template's is, and halfway between both at the corners."""
    inward = np.minimum(eye.columns - eye.columns[0], eye.columns[-1] - eye.columns)
    least_rise, ends = _rise(points, eye, carried), np.clip(inward / _END, 0.0, 1.0)
    rise = least_rise + (0.5 - least_rise) * (1.0 - smoothstep(inward / _CANTHUS))
    line = _smooth(eye.lower + rise * (eye.upper - eye.lower), 3)
    step = _rim(eye, before, 1) - _rim(eye, before, -1)
    excess = _smooth(0.5 * (step - np.clip(step, -_STEP_MM, _STEP_MM)) * ends, 15)
    ways = np.stack([line - ends * _OVER_MM / eye.globe.radius - eye.upper, line - eye.lower])
    # an upright edge at a corner bends over the hole's last columns: its ends move as those before it do
    last = len(eye.columns) - 1
    inner = np.clip(np.arange(last + 1), min(_BENT, (last + 1) // 2), max(last - _BENT, 0))
    return _Meeting(line=line, ways=ways[:, inner], excess=excess, ends=ends)


def _settled(points: FloatArray, met: FloatArray, triangles: IntArray, eye: Aperture, gap: float) -> FloatArray:
    """Lids that have `met` with no triangle turned over nor in the eyeball, as far as that leaves no wider gap."""
    seen = _seen(points, triangles, eye)
    best, fewest = _clear(points, met, seen, eye), len(seen) + 1
    # of the margins what the outline needs stays, or nothing, or all, where that opens the eye
    for outline in (_OUTLINE, 0.0, np.inf):
        ended = met
        for _ in range(_SETTLES):  # each may undo a little of the other
            ended = _clear(points, _unfolded(points, ended, triangles, seen, eye, outline), seen, eye)
            flips = int(flipped_triangles(points, ended, seen).sum())
            if flips < fewest and _gaps(ended, triangles, eye).max(initial=0.0) <= max(gap, _OPEN_MM):
                best, fewest = ended, flips
            if not flips:
                break
        if not fewest:
            break
    return best


def slid(points: FloatArray, triangles: IntArray, eye: Aperture, carried: FloatArray) -> FloatArray:
    """(n, 3) mm of a shape that moves lids without closing them, with no lid deeper in the eyeball than it was."""
    moving = np.linalg.norm(carried[eye.near[eye.distance < eye.width]], axis=1).max(initial=0.0)
    if eye.globe.surface is None or moving < _SLIDES_MM:
        return carried
    start, ended = points[eye.near], points + carried
    ended[eye.near] = _lifted(eye, ended[eye.near], _floor(eye.polar(start)[:, 2]))
    return _clear(points, ended, _seen(points, triangles, eye), eye) - points


def _rim(eye: Aperture, polar: FloatArray, side: int) -> FloatArray:
    """(c,) mm that the outside of a lid's rim lies over the globe."""
    rows = np.flatnonzero((eye.side == side) & (eye.distance < _RIM_MM * eye.width / _WIDTH))
    if not len(rows):
        return np.zeros_like(eye.columns)
    rows = rows[np.argsort(polar[rows, 0], kind="stable")]
    columns, heights = polar[rows, 0], polar[rows, 2]
    first, last = (np.searchsorted(columns, columns + end) for end in (-_CORNER, _CORNER))
    outer = [heights[a:b].max() for a, b in zip(first, np.maximum(last, first + 1), strict=True)]
    return np.asarray(np.interp(eye.columns, columns, outer))


def _reach(eye: Aperture, side: int) -> tuple[float, float]:
    """mm along the skin: a lid goes wholly with its margin up to, and not at all beyond."""
    low, high = _FOLLOWS[side]
    scale = eye.width / _WIDTH
    travel = float((eye.upper - eye.lower).max()) * eye.globe.radius if side > 0 else 0.0
    return low * scale, max(high * scale, 0.9 * travel)


def _rise(points: FloatArray, eye: Aperture, carried: FloatArray) -> float:
    """The share of the way that the template's lower lid goes."""
    rows = np.flatnonzero((eye.side < 0) & (eye.distance < 0.5))
    before, after = eye.polar(points[eye.near[rows]]), eye.polar((points + carried)[eye.near[rows]])
    opening = np.interp(before[:, 0], eye.columns, eye.upper - eye.lower, left=0.0, right=0.0)
    wide = opening > 0.5 * (eye.upper - eye.lower).max()
    if not wide.any():
        return _USUAL_RISE
    return float(np.clip(np.median((after[wide, 1] - before[wide, 1]) / opening[wide]), *_RISE))


def _floor(heights: FloatArray) -> FloatArray:
    """mm over the globe that points keep at least: those that were outside stay there, those inside are left alone."""
    return np.where(heights >= 0, np.minimum(heights, 0.1), -np.inf)


def _lifted(eye: Aperture, points: FloatArray, floor: FloatArray) -> FloatArray:
    """Points (k, 3) not deeper than their `floor`, along the rays from the globe's centre."""
    if eye.globe.surface is None:
        return points
    offsets = points - eye.globe.centre
    lengths = np.linalg.norm(offsets, axis=1)
    least = eye.globe.reach(offsets) + floor
    return np.asarray(points + (np.maximum(least - lengths, 0.0) / np.maximum(lengths, 1e-9))[:, None] * offsets)


def _gaps(points: FloatArray, triangles: IntArray, eye: Aperture) -> FloatArray:
    """(c,) mm that no skin covers in each column of the aperture."""
    low = np.array([eye.columns[0], eye.lower.min() - 0.1])
    window = np.stack([low, [eye.columns[-1], eye.upper.max() + 0.1]])
    skin = triangles[_outward(points, triangles, eye)]  # their inner sides hide no eye
    moved = _Directions.of(points, skin, eye.globe, eye.axes, window)
    turns = moved.at(np.arange(len(moved.depth)), 1)[:, None]
    bare = ~np.isfinite(moved.depth)[:, : len(eye.columns)] & (turns > eye.lower - _CELL) & (turns < eye.upper + _CELL)
    return np.asarray(bare.sum(axis=0) * _CELL * eye.globe.radius * np.cos(eye.columns))


def _pooled(gaps: FloatArray, eye: Aperture, start: FloatArray, triangles: IntArray) -> FloatArray:
    """(c,) the largest gap as far along as edges at the margin are long."""
    from scipy.ndimage import maximum_filter1d

    place = np.full(int(triangles.max()) + 1, -1)
    rim = np.flatnonzero(eye.distance < 0.3)
    place[eye.near[rim]] = rim
    pairs = place[np.concatenate([triangles[:, :2], triangles[:, 1:], triangles[:, [2, 0]]])]
    pairs = pairs[(pairs >= 0).all(axis=1)]
    longest = np.linalg.norm(start[pairs[:, 0]] - start[pairs[:, 1]], axis=1).max(initial=0.0)
    cells = min(round(longest / eye.globe.radius / _CELL), len(gaps))
    return np.asarray(maximum_filter1d(gaps, 2 * cells + 1))


def _unfolded(
    points: FloatArray, ended: FloatArray, triangles: IntArray, seen: IntArray, eye: Aperture, kept: float
) -> FloatArray:
    """`ended` with the motion of points of triangles that turn over made that of those around.

    :param kept: radians from the hole, up to which points of the margins stay where they meet
    """
    margin = np.zeros(len(points), bool)
    polar = eye.polar(points[eye.near])
    upper, lower = (np.interp(polar[:, 0], eye.columns, row) for row in (eye.upper, eye.lower))
    outline = np.abs(polar[:, 1] - np.where(eye.side > 0, upper, lower)) < kept
    wide = (upper - lower > _NARROW * (eye.upper - eye.lower).max()) & (polar[:, 0] > eye.columns[0])
    margin[eye.near[(eye.distance <= 0) & outline & wide & (polar[:, 0] < eye.columns[-1])]] = True
    return unfolded(points, ended, triangles, seen, margin)


_PLACES = np.array([(i, j, 6 - i - j) for i in range(7) for j in range(7 - i)]) / 6.0  # of a triangle


def _clear(points: FloatArray, ended: FloatArray, seen: IntArray, eye: Aperture) -> FloatArray:
    """`ended` with points lifted until the triangles `seen` lie no deeper in the eyeball than they did in `points`.

    Others are left alone: the fold of the socket and the lids' inner sides belong inside.
    """
    if eye.globe.surface is None:
        return ended
    kept = seen[np.linalg.norm(points[seen].mean(axis=1) - eye.globe.centre, axis=1) < 2.5 * eye.globe.radius]
    before, after = _heights(points, kept, eye), _heights(ended, kept, eye)
    least = np.where(before > 0, np.minimum(before, _TOUCH_MM), before)
    ended = ended.copy()
    for _ in range(2 * _ROUNDS):
        short = np.maximum(least - after, 0.0).max(axis=1)
        if short.max(initial=0.0) <= 0.2 * _TOUCH_MM:
            break
        lift = np.zeros(len(points))
        np.maximum.at(lift, kept, short[:, None])
        rows = np.flatnonzero(lift)
        offsets = ended[rows] - eye.globe.centre
        ended[rows] += (lift[rows] / np.linalg.norm(offsets, axis=1))[:, None] * offsets
        after = _heights(ended, kept, eye)
    return ended


def _heights(points: FloatArray, triangles: IntArray, eye: Aperture) -> FloatArray:
    """(t, s) mm that places of triangles lie over the globe."""
    places = np.einsum("sc,tci->tsi", _PLACES, points[triangles])
    return eye.globe.heights(places.reshape(-1, 3)).reshape(len(triangles), -1)


def _outward(points: FloatArray, triangles: IntArray, eye: Aperture) -> BoolArray:
    """(t,) which triangles face away from the eyeball's middle."""
    towards = points[triangles].mean(axis=1) - eye.globe.centre
    return np.asarray((triangle_normals(points, triangles) * towards).sum(axis=1) > 0)


def lid_figures(points: FloatArray, delta: FloatArray, triangles: IntArray, eye: Aperture) -> LidFigures:
    """How lids of (n, 3) points close that move by `delta` (n, 3)."""
    ended = points + delta
    gaps = _gaps(ended, triangles, eye)
    seen = _seen(points, triangles, eye)
    ball = eye.globe.surface is not None
    before, after = (_heights(one, seen, eye) for one in (points, ended))
    return LidFigures(
        gap_mean=float(gaps.mean()),
        gap_most=float(gaps.max(initial=0.0)),
        in_ball=float(-after.min(initial=0.0)) if ball else 0.0,
        in_ball_neutral=float(-before.min(initial=0.0)) if ball else 0.0,
        lid_flips=int(flipped_triangles(points, ended, seen).sum()),
    )


def _seen(points: FloatArray, triangles: IntArray, eye: Aperture) -> IntArray:
    """(k, 3) the triangles around an eye that are seen from before it, by what is nearest on a grid."""
    around = np.zeros(len(points), bool)
    around[eye.near[eye.distance < eye.width]] = True
    kept = triangles[around[triangles].all(axis=1)]
    if not len(kept):
        return kept
    grid = Grid.of(points @ eye.axes.T, kept)
    depth, number = grid.first(kept)
    return kept[np.unique(number[(number >= 0) & (depth >= grid.first(triangles)[0])])]
