"""Eyes and mouth of a person, fitted to the skin: identity modes move skin and what is inside it each in their own way.

Eyes: round eyeballs where the lids want them, and lids that slide over them and meet in a blink. Linear shapes of lids
cut the eyeball of one person and leave that of another open. Rings of points go around each eye: 0 behind the margin, 1
to 4 the margin, then out over the lid (`samples/head/lids.py`).

Mouth: its inside is kept behind the skin, and teeth draw back where lips lie otherwise before them than usual.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.spatial import cKDTree

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.polygons import point_normals, point_triangles
from facepipe.heads.asset import asset
from facepipe.heads.lid_fit import SIDES, Socket, sockets

Shapes = Mapping[str, Mapping[float, FloatArray]]

_WAYS = (0.25, 0.5, 0.75)
# by ring
_LEAST = np.array([-1, 0.0, 0.025, 0.08, 0.14, 0.17, 0.17, 0.17, 0.17, 0.15, 0.1, -1, -1])  # cm over the eyeball
_FOLLOW = np.array([0.6, 0.95, 1, 1, 1, 0.95, 0.81, 0.6, 0.42, 0.27, 0.17, 0.09, 0.03])  # of the margin's motion
_MARGIN = 4  # the last ring of the margin
_TOUCH = (2, 3)  # rings that lie on the eyeball as it does in the average head
_SOFT = 0.015  # cm, over which lids begin to be lifted
_OVER = 0.04  # cm that the upper margin goes below the lower, so that no gap shows
_TAPER = 0.04  # of the eye's width from each corner, where margins meet anyway
_INSIDE = 3.0  # how much more it weighs that a lid is inside the eyeball than that it is off it
_STEPS = 6  # of Gauss and Newton
_STILL = 1e-6  # radians; an arc below that is straight
_NEAREST = 3  # points of the eyeball that say how far it reaches in a direction
_SKIN, _MOUTH = 9409, slice(11248, 13294)  # points of the face before these; points of the mouth's inside
_LIPS = 0.15  # cm; what lies less deep belongs to the lips
_DEPTH_KEPT = 0.5  # of its depth in the average head that a point keeps
_SKIN_POINTS = 8  # points of the skin that it is kept behind
_UPPER_LIP, _LOWER_LIP = (61, 62, 63), (65, 66, 67)  # inner landmarks
_INCISORS = 1.6, 0.6  # cm to each side of the middle, and behind the foremost of their row
_DRAWN_BACK = 0.15  # cm at most


@dataclass(frozen=True, kw_only=True)
class _Ball:
    """The eyeball of a person: the average one, moved and scaled."""

    socket: Socket
    centre: FloatArray
    scale: float

    def above(self, lids: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Unit directions (k, 3) of points from the centre, and how far (k,) they lie over the eyeball."""
        offsets = lids - self.centre
        lengths = np.linalg.norm(offsets, axis=1)
        directions = offsets / lengths[:, None]
        away, near = self.socket.shell.query(directions, k=_NEAREST)
        weights = 1.0 / (away + 1e-3)
        reach = (weights * self.socket.radii[near]).sum(axis=1) / weights.sum(axis=1)
        return directions, lengths - self.scale * reach

    def lifted(self, lids: FloatArray) -> FloatArray:
        """Lids (k, 3) that lie over the eyeball as much as they must."""
        directions, height = self.above(lids)
        least = _LEAST[self.socket.rings]
        lift = np.where(least < 0, 0.0, _SOFT * np.logaddexp(0.0, (least - height) / _SOFT))
        return lids + lift[:, None] * directions


def fit_eyes(points: FloatArray, shapes: Shapes) -> tuple[FloatArray, Shapes]:
    """Points (n, 3) of a person with eyeballs that fit the lids, and the shapes with blinks of the person's own.

    :param shapes: name -> weight, 1 the last -> (n, 3) offsets there
    """
    points, shapes = points.copy(), dict(shapes)
    eyes, average = sockets(), asset().points
    # both eyeballs are of one size
    spreads = [(one[each.ball] - one[each.ball].mean(axis=0)).std() for one in (points, average) for each in eyes]
    scale = float((spreads[0] + spreads[1]) / (spreads[2] + spreads[3]))
    balls = []
    for each in eyes:
        start = each.centre + (points[each.ball] - average[each.ball]).mean(axis=0)
        eyeball = _Ball(socket=each, centre=start, scale=scale)
        # moved a little, so that the lids lie on it as the average ones do on theirs
        touching = np.isin(each.rings, _TOUCH)
        goal = _Ball(socket=each, centre=each.centre, scale=1.0).above(average[each.lids])[1][touching]
        for _ in range(_STEPS):
            directions, height = eyeball.above(points[each.lids])
            miss = height[touching] - goal
            weights = np.where(miss < 0, _INSIDE, 1.0)
            rows = np.vstack([directions[touching] * weights[:, None], np.eye(3)])
            step = np.linalg.lstsq(rows, np.append(miss * weights, start - eyeball.centre), rcond=None)[0]
            eyeball = replace(eyeball, centre=eyeball.centre + step)
        balls.append(eyeball)
    for side, ball in zip(SIDES, balls, strict=True):
        eye = ball.socket
        points[eye.ball] = ball.centre + ball.scale * (average[eye.ball] - eye.centre)
        points[eye.lids] = ball.lifted(points[eye.lids])
        name = f"eyeBlink{side}"
        shapes[name] = _blink(points, shapes[name], ball)
    return points, shapes


def _blink(points: FloatArray, blink: Mapping[float, FloatArray], ball: _Ball) -> Mapping[float, FloatArray]:
    """The blink of a person, with inbetweens on which the lids slide over the eyeball."""
    eye, start = ball.socket, points[ball.socket.lids]
    lids = ball.lifted(start + blink[1.0][eye.lids])
    # blinking lids (k, 3) with the upper margin brought onto the lower one, and the lid drawn after it
    inner, outer = lids[eye.corners]
    axis = (outer - inner) / ((outer - inner) @ (outer - inner))
    down = np.cross(axis, [0.0, 0.0, 1.0])
    down *= -np.sign(down[1]) / np.linalg.norm(down)
    along, met = (lids - inner) @ axis, lids.copy()
    for ring in range(len(_FOLLOW)):
        margin = eye.rings == min(ring, _MARGIN)
        both = (np.flatnonzero(margin & one) for one in (eye.upper, ~eye.upper))
        upper, lower = (rows[np.argsort(along[rows], kind="stable")] for rows in both)
        goal = _at(along[upper], along[lower], lids[lower])
        ends = along[upper] - along[lower[0]], along[lower[-1]] - along[upper]
        taper = np.clip(np.minimum(*ends) / _TAPER, 0.0, 1.0)[:, None]
        way = (goal - lids[upper]) * taper
        way += _OVER * taper * down - (way @ axis)[:, None] * (outer - inner)
        own = upper if ring <= _MARGIN else np.flatnonzero((eye.rings == ring) & eye.upper)
        met[own] += _FOLLOW[ring] * _at(along[own], along[upper], way)
    end = ball.lifted(met)
    fitted = {}
    for share in (*_WAYS, 1.0):
        offsets = blink[share].astype(np.float64)
        centre = ball.centre  # points go `share` of their way from start to end on arcs around it
        lengths = [np.linalg.norm(one - centre, axis=1, keepdims=True) for one in (start, end)]
        a, b = (start - centre) / lengths[0], (end - centre) / lengths[1]
        angle = np.maximum(np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(axis=1)), _STILL)[:, None]
        turned = (np.sin((1 - share) * angle) * a + np.sin(share * angle) * b) / np.sin(angle)
        arced = np.asarray(centre + ((1 - share) * lengths[0] + share * lengths[1]) * turned)
        offsets[eye.lids] = ball.lifted(arced) - start
        fitted[share] = offsets
    fitted[1.0][eye.lids] = end - start
    return fitted


def _at(along: FloatArray, known: FloatArray, values: FloatArray) -> FloatArray:
    """(k, 3) values between those (m, 3) at `known` (m,)."""
    return np.stack([np.interp(along, known, column) for column in values.T], axis=1)


def fit_mouth(points: FloatArray) -> FloatArray:
    """The (n, 3) points of a head with the mouth's inside half as deep at least as it is in the average head."""
    inside, skin, least = _pairs()
    normals = point_normals(points[:_SKIN], _triangles())[skin]
    depths = ((points[skin] - points[inside, None]) * normals).sum(axis=-1)
    missing = np.maximum(least - depths, 0.0)
    most = missing.argmax(axis=1)
    rows = np.arange(len(inside))
    fitted = points.copy()
    fitted[inside] -= missing[rows, most, None] * normals[rows, most]
    for name in ("Teeth", "GumsAndTongue"):
        fitted[asset().parts[name].points, 2] -= _drawn_back(points)
    return fitted


def _drawn_back(points: FloatArray) -> float:
    """How far in cm teeth and gums go back: a lip that rolls in passes before teeth in the way of the average head.

    Shapes are the same for all: where lips lie nearer or farther before the teeth than usual, teeth came up to 1 mm
    through the rolled lip of 3 in 30 people.
    """
    lips, rows, usual = _lips_and_incisors()
    apart = [points[lip, 2].mean() - points[row, 2].mean() for lip in lips for row in rows]
    return min(float(np.abs(np.array(apart) - usual).max()), _DRAWN_BACK)


@cache
def _lips_and_incisors() -> tuple[tuple[IntArray, ...], tuple[IntArray, ...], FloatArray]:
    """Points of both lips and of upper and lower incisors, and how far each lip is before each of these on average."""
    head = asset()
    lips = tuple(head.landmarks[list(one)] for one in (_UPPER_LIP, _LOWER_LIP))
    teeth = np.arange(head.parts["Teeth"].points.start, head.parts["Teeth"].points.stop)
    teeth = teeth[np.abs(head.points[teeth, 0]) < _INCISORS[0]]
    lower = np.linalg.norm(head.shapes["jawOpen"][1.0][teeth], axis=1) > _LIPS
    rows = []
    for own in (teeth[~lower], teeth[lower]):
        depth = head.points[own, 2]
        rows.append(own[depth > depth.max() - _INCISORS[1]])
    usual = [head.points[lip, 2].mean() - head.points[row, 2].mean() for lip in lips for row in rows]
    return lips, tuple(rows), np.array(usual)


@cache
def _pairs() -> tuple[IntArray, IntArray, FloatArray]:
    """(k,) points of the mouth's inside, (k, 8) the points of the skin before them, and how deep they have to lie."""
    points = asset().points
    inside = np.arange(_MOUTH.start, _MOUTH.stop)
    skin = cKDTree(points[:_SKIN]).query(points[inside], _SKIN_POINTS)[1]
    normals = point_normals(points[:_SKIN], _triangles())[skin]
    depths = ((points[skin] - points[inside, None]) * normals).sum(axis=-1)
    deep = depths.min(axis=1) > _LIPS
    return inside[deep], skin[deep], _DEPTH_KEPT * depths[deep]


@cache
def _triangles() -> IntArray:
    triangles = point_triangles(asset().counts, asset().indices)
    return triangles[(triangles < _SKIN).all(axis=1)]
