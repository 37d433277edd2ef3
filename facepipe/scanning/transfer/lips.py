"""Lips that meet: what a template brings is made to close the mouth of the head itself, column by column.

A column is a place on the way from corner to corner; of all that faces forwards of the upper lip its lowest place there
is the rim, and of the lower lip its highest. Rims are found anew in each pose, as lips roll. Where triangles join the
lips there is no mouth: corners are where that begins.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.geometry.geodesics import graph_distances, surface_graph
from facepipe.geometry.polygons import flipped_triangles, triangle_normals
from facepipe.scanning.transfer.rims import RIMS, Frame, Lid
from facepipe.scanning.transfer.unfold import unfolded
from facepipe.verbs.skin.surface import smoothstep

_STATIONS = np.linspace(0.0, 1.0, 97)  # of the way from corner to corner
_ABOVE, _BELOW = [49, 50, 51, 52, 53], [59, 58, 57, 56, 55]  # landmarks of the outer lips
_NEAR = 1.0  # of the mouth's width from its middle: skin that counts
_DEPTH, _HEIGHT = 0.2, 0.6  # of the mouth's width from its landmarks: what is a lip
_JOINED_DEPTH = 0.1  # and what joins them at corners, not the back of the inner mouth
_NARROWEST = 0.4  # of the mouth's width: less of an opening is none
_FOLLOWS = 0.2  # of the mouth's width along the skin from its rim: so far a lip goes along
_BAND = 3  # columns at corners, where a rim may seem to end off the corner
_CORNER = 8  # columns at corners, whose points give way where triangles would turn over
_DEGREE, _SHARES = 4, (0.3, 1.5)  # of the share of mouthClose along the mouth
_ROUNDS = 10
_SETTLED_MM = 0.02
_MOST_OVER_MM = 0.35  # that lips go into one another at 1, so that at 0.5 those that were apart are half as far
_HALF_MM = 0.1  # of gaps at 0.5
_APART_MM = 0.3  # of a template's lips: up to which they stay shut in a shape


@dataclass(frozen=True, kw_only=True)
class LipFigures:
    """How lips meet, in millimetres."""

    gap_mean: float  # from corner to corner, with jawOpen and mouthClose at 1
    gap_most: float
    over_most: float  # how far they cross, beyond what they do in the neutral
    half_most: float  # the widest gap with both at 0.5
    lip_flips: int  # triangles of the lips that face forwards at rest and turn over


class Rim(NamedTuple):
    """Places on edges."""

    ends: IntArray  # (s, 2) points
    shares: FloatArray  # (s,) of the second


@dataclass(frozen=True, kw_only=True)
class Lips:
    """The lips of a skin with n points."""

    frame: Frame
    triangles: tuple[IntArray, IntArray]  # (k, 3) of the upper and the lower lip
    joined: IntArray  # (j, 3) triangles from the one to the other, at corners
    rims: tuple[Rim, Rim]  # at rest, at s columns from corner to corner
    near: IntArray  # (m,) points that go with a lip
    side: IntArray  # (m,) 1 above, -1 below
    follow: FloatArray  # (m,) how much they go with the rim

    def on_rims(self, values: FloatArray) -> FloatArray:
        """(2, s, 3) values of points (n, 3) at the upper and the lower rim as it is at rest."""
        return np.stack([values[ends[:, 0]] + share[:, None] * (values[ends[:, 1]] - values[ends[:, 0]])
                         for ends, share in self.rims])  # fmt: skip

    def columns(self, pose: FloatArray) -> FloatArray:
        """(s,) places along of the columns in a pose: a mouth that goes aside takes them with it."""
        along = self.frame.local(self.on_rims(pose))[..., 0].mean(axis=0)
        return np.asarray(np.maximum.accumulate(along))

    def gaps(self, pose: FloatArray) -> FloatArray:
        """(s,) mm between the rims in a pose; below 0 where they cross, 0 where they are joined."""
        columns = self.columns(pose)
        upper, lower = (
            _rim(self.frame, pose, one, sign, columns)[2] for one, sign in zip(self.triangles, (1, -1), strict=True)
        )
        known = np.isfinite(upper) & np.isfinite(lower)
        if not known.any():
            return np.zeros_like(upper)
        gaps = self.frame.width * np.interp(_STATIONS, _STATIONS[known], (upper - lower)[known])
        shut = _shut(self.frame, pose, self.joined, columns)
        gaps = np.where(shut, 0.0, gaps)
        # the point of a corner counts to one lip alone: beside it the other's rim seems to end off it
        shown = np.flatnonzero(~shut)
        if len(shown) > 2 * _BAND:
            for band, beside in ((shown[:_BAND], shown[_BAND]), (shown[-_BAND:], shown[-_BAND - 1])):
                gaps[band] = np.clip(gaps[band], min(gaps[beside], 0.0), max(gaps[beside], 0.0))
        return gaps

    def seen(self, points: FloatArray) -> IntArray:
        """(k, 3) triangles of the lips that face forwards."""
        every = np.concatenate(self.triangles)
        return np.asarray(every[triangle_normals(points, every) @ self.frame.axes[2] > 0])

    def parting(self, delta: FloatArray) -> FloatArray:
        """(s, 3) mm by which a motion (n, 3) takes the upper rim away from the lower one, in the frame."""
        upper, lower = self.on_rims(delta) @ self.frame.axes.T
        return np.asarray(upper - lower)

    def moved(self, pose: FloatArray, apart: FloatArray) -> FloatArray:
        """A pose (n, 3) with the rims farther apart by (s, 3) mm, half by each lip."""
        along, columns = self.frame.local(pose[self.near])[:, 0], self.columns(pose)
        way = np.stack([np.interp(along, columns, one, left=0.0, right=0.0) for one in apart.T], axis=1)
        result = pose.copy()
        result[self.near] += (0.5 * self.side * self.follow)[:, None] * way
        return result


def lips_of(points: FloatArray, triangles: IntArray, landmarks: FloatArray) -> Lips | None:
    """The lips of a skin; None: its mouth is no opening.

    :param points: (n, 3) mm, cuts sewn, upright and looking along Z
    :param triangles: (t, 3) of the skin, outward
    :param landmarks: (68, 3) mm
    """
    frame = _upright(landmarks)
    used = np.unique(triangles)
    used = used[np.linalg.norm(points[used] - landmarks[48:68].mean(axis=0), axis=1) < _NEAR * frame.width]
    place = np.full(len(points), -1)
    place[used] = np.arange(len(used))
    kept = place[triangles]
    kept = kept[(kept >= 0).all(axis=1)]
    if not len(kept):
        return None
    graph = surface_graph(points[used], np.pad(kept, ((0, 0), (0, 1)), constant_values=-1))
    seeds = [
        np.unique([np.linalg.norm(points[used] - mark, axis=1).argmin() for mark in landmarks[marks]])
        for marks in (_ABOVE, _BELOW)
    ]
    away = graph_distances(graph, seeds)
    side = np.where(away[0] <= away[1], 1, -1)
    own = used[kept]
    sides = side[kept]
    near = _near(frame, points[own].mean(axis=1), _DEPTH)
    lips = own[near & (sides > 0).all(axis=1)], own[near & (sides < 0).all(axis=1)]
    joined = own[(np.abs(sides.sum(axis=1)) < 3) & _near(frame, points[own].mean(axis=1), _JOINED_DEPTH)]
    stations = _open(frame, points, joined)
    if stations is None or not all(map(len, lips)):
        return None
    at_rest = [_rest(frame, points, one, sign, stations) for one, sign in zip(lips, (1, -1), strict=True)]
    rims = [one for one in at_rest if one is not None]
    if len(rims) < 2:
        return None
    columns = np.arange(len(stations))
    seeds = [np.unique(place[one.ends[columns, (one.shares > 0.5).astype(np.int64)]]) for one in rims]
    away = graph_distances(graph, seeds)
    distance = np.where(side > 0, away[0], away[1])
    follow = 1.0 - smoothstep(distance / (_FOLLOWS * frame.width))
    goes = np.flatnonzero(follow > 0)
    return Lips(
        frame=frame, triangles=(lips[0], lips[1]), joined=joined, rims=(rims[0], rims[1]), near=used[goes],
        side=side[goes], follow=follow[goes],
    )  # fmt: skip


def met(points: FloatArray, lips: Lips, jaw: FloatArray, close: FloatArray) -> FloatArray:
    """(n, 3) mm of mouthClose that brings the lips together where `jaw` opens them.

    `close` times a smooth share for each column, as it may be too much of it at corners by a third (that of
    ICT-FaceKit's own head is), and what is missing then added at the lips alone.
    """
    at_rest = lips.gaps(points)
    goal = np.minimum(at_rest, 0.0) - np.clip(at_rest, 0.0, _MOST_OVER_MM)
    opened, shut = (lips.parting(delta)[:, 1] for delta in (jaw, close))
    terms = np.polynomial.polynomial.polyvander(2.0 * _STATIONS - 1.0, _DEGREE)
    share = terms @ np.linalg.lstsq(terms * shut[:, None], goal - at_rest - opened, rcond=None)[0]
    share = np.clip(share, *_SHARES)
    scaled = np.interp(lips.frame.local(points)[:, 0], lips.columns(points), share)[:, None] * close
    ended = points + jaw + scaled
    across = -lips.parting(jaw + scaled)[:, 2:] * lips.frame.axes[2]
    ended = lips.moved(ended, _faded(across))
    ended = held(lips, ended, goal, goal)
    rims = np.zeros(len(points), bool)
    rims[np.concatenate([one.ends[_CORNER:-_CORNER].ravel() for one in lips.rims])] = True
    return (
        unfolded(points, ended, np.concatenate([*lips.triangles, lips.joined]), lips.seen(points), rims) - points - jaw
    )


def held(lips: Lips, ended: FloatArray, least: FloatArray, most: FloatArray) -> FloatArray:
    """A pose (n, 3) with gaps of at least and at most (s,) mm: both lips go half of what is missing."""
    for _ in range(_ROUNDS):
        gaps = lips.gaps(ended)
        wrong: FloatArray = np.asarray(np.clip(gaps, least, most) - gaps)
        # where joined triangles hide the rims in this pose, they go with those beside: coarse meshes have points there
        shown = ~_shut(lips.frame, ended, lips.joined, lips.columns(ended))
        if shown.any():
            wrong = np.asarray(np.interp(_STATIONS, _STATIONS[shown], wrong[shown]))
        wrong = _faded(wrong[:, None])[:, 0]
        if np.abs(wrong).max() <= _SETTLED_MM:
            break
        ended = lips.moved(ended, wrong[:, None] * lips.frame.axes[1])
    return ended


def half_met(points: FloatArray, lips: Lips, jaw: FloatArray, close: FloatArray) -> FloatArray | None:
    """(n, 3) mm of mouthClose at 0.5, where half of it leaves lips apart that meet at 1; None: it does not.

    Lips that are apart by more than they may go into one another at 1 are so at 0.5 by half of what is left.
    """
    half = 0.5 * (jaw + close)
    if lips.gaps(points + half).max(initial=0.0) <= _HALF_MM:
        return None
    goal = np.minimum(lips.gaps(points), 0.0)
    return held(lips, points + half, np.full(len(goal), -np.inf), goal) - points - 0.5 * jaw


def as_shut(points: FloatArray, lips: Lips, delta: FloatArray, rest: FloatArray, posed: FloatArray) -> FloatArray:
    """(n, 3) mm of a shape in which lips are neither opened nor crossed where those of the template are not.

    :param rest: (s,) mm between the template's lips, and `posed` (s,) in the shape
    """
    own, shift = lips.gaps(points), posed - rest
    most = np.where(posed <= np.maximum(rest, 0.0) + _APART_MM, np.maximum(own, 0.0) + np.maximum(shift, 0.0), np.inf)
    least = np.minimum(own, 0.0) + np.minimum(shift, 0.0) - _APART_MM
    return held(lips, points + delta, least, np.maximum(most, least)) - points


def figures(
    points: FloatArray, lips: Lips, jaw: FloatArray, close: FloatArray, half: FloatArray | None = None
) -> LipFigures:
    """How the lips of n points meet.

    :param half: (n, 3) mm of mouthClose at 0.5; None: half of it
    """
    halfway = 0.5 * jaw + (0.5 * close if half is None else half)
    rest, whole, middle = (lips.gaps(points + delta) for delta in (np.zeros_like(jaw), jaw + close, halfway))
    return LipFigures(
        gap_mean=float(np.maximum(whole, 0.0).mean()),
        gap_most=float(whole.max(initial=0.0)),
        over_most=float((np.minimum(rest, 0.0) - whole).max(initial=0.0)),
        half_most=float(middle.max(initial=0.0)),
        lip_flips=int(flipped_triangles(points, points + jaw + close, lips.seen(points)).sum()),
    )


def _upright(landmarks: FloatArray) -> Frame:
    """The mouth's frame with its upward axis that of the head's place: seen from where the face looks.

    From chin to nose, which is upwards of eyes and mouth alike elsewhere, is off by 6 to 18 degrees; so seen, lips that
    lie one before the other seem to meet and have a slit between them.
    """
    frame = Frame.of(landmarks, *RIMS[0])
    along = frame.axes[0]
    up = np.array([0.0, 1.0, 0.0]) - along[1] * along
    up /= max(float(np.linalg.norm(up)), 1e-9)
    turned = frame._replace(axes=np.stack([along, up, np.cross(along, up)]))
    local = turned.local(frame.origin + frame.width * frame.rim @ frame.axes)
    return turned._replace(rim=local[np.argsort(local[:, 0], kind="stable")])


def _near(frame: Frame, places: FloatArray, depth: float) -> BoolArray:
    """(k,) which places (k, 3) are at the mouth."""
    local = frame.local(places)
    away = np.abs(local[:, 2] - np.interp(local[:, 0], frame.rim[:, 0], frame.rim[:, 2]))
    return np.asarray((away <= depth) & (np.abs(local[:, 1] - frame.rim[:, 1].mean()) <= _HEIGHT))


def _open(frame: Frame, points: FloatArray, joined: IntArray) -> FloatArray | None:
    """(s,) places along from corner to corner, between triangles that join the lips."""
    stations = -0.2 + 1.4 * _STATIONS
    shut = _shut(frame, points, joined, stations)
    ends = np.flatnonzero(shut)
    middle = len(stations) // 2
    first = stations[ends[ends < middle].max(initial=0)]
    last = stations[ends[ends > middle].min(initial=len(stations) - 1)]
    if shut[middle] or last - first < _NARROWEST:
        return None
    return np.asarray(first + (last - first) * _STATIONS)


def _shut(frame: Frame, points: FloatArray, joined: IntArray, stations: FloatArray) -> BoolArray:
    """(s,) where triangles that join the lips face forwards."""
    forwards = triangle_normals(points, joined) @ frame.axes[2] > 0
    along = frame.local(points[joined[forwards]].reshape(-1, 3))[:, 0].reshape(-1, 3)
    low, high = along.min(axis=1, initial=np.inf), along.max(axis=1, initial=-np.inf)
    return np.asarray(((stations >= low[:, None]) & (stations <= high[:, None])).any(axis=0))


def _rim(
    frame: Frame, points: FloatArray, triangles: IntArray, sign: int, stations: FloatArray
) -> tuple[IntArray, FloatArray, FloatArray, IntArray]:
    """What `Lid.envelope` finds, of what faces forwards in a pose, and the ends (e, 2) of those edges."""
    shown = triangles[triangle_normals(points, triangles) @ frame.axes[2] > 0]
    ends = np.concatenate([shown[:, :2], shown[:, 1:], shown[:, [2, 0]]])
    lid = Lid(ends=ends, places=frame.local(points[ends].reshape(-1, 3)).reshape(-1, 2, 3), sign=sign)
    return *lid.envelope(stations), ends


def _rest(frame: Frame, points: FloatArray, triangles: IntArray, sign: int, stations: FloatArray) -> Rim | None:
    """The rim of a lip at rest, where there is none that beside; None: nowhere."""
    edge, share, height, ends = _rim(frame, points, triangles, sign, stations)
    known = np.flatnonzero(np.isfinite(height))
    if not len(known):
        return None
    nearest = known[np.abs(np.arange(len(stations))[:, None] - known).argmin(axis=1)]
    return Rim(ends=ends[edge[nearest]], shares=share[nearest])


def _faded(values: FloatArray) -> FloatArray:
    """(s, k) values that end at the corners."""
    faded = values.copy()
    faded[[0, -1]] = 0.0
    return faded
