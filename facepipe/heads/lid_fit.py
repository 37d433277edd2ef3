"""Lids that follow gaze: looks and squints that keep the lids of a person before the eyeballs.

Linear shapes of lids were made on one eyeball that did not turn. Of others, a turned cornea and a white that is not
round come through lids, the more so where a slider has moved or widened the eye. Points of lids that would lie inside
the eyeball in one of these poses are pushed out along its radius, and the skin beside them a little less.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.balls import fit_ball
from facepipe.heads.asset import arrays, asset

SIDES = ("Left", "Right")
TURN = 0.5  # radians that an eye turns to the side, and up or down, at 1
SQUINT = "eyeSquint"
LOOKS: Mapping[str, tuple[float, float]] = {  # shape -> how the left eye turns about x and about y, radians
    "eyeLookUp": (-TURN, 0.0),
    "eyeLookDown": (TURN, 0.0),
    "eyeLookIn": (0.0, -TURN),
    "eyeLookOut": (0.0, TURN),
}
_HALF = 0.5  # a weight at which looks are kept out of the eyeball too
_FAR = -9.0  # cm: below all that lies over an eyeball
_RINGS = 13  # of lids; at rest the skin around them counts too, as rings farther out
_AROUND = 5  # of those
# by ring, cm over the eyeball
_LEAST = np.array([_FAR, 0.0, 0.02, 0.06, 0.10, 0.12, 0.12, 0.12, 0.12, 0.12, 0.10, _FAR, _FAR])
_LEAST_AT_ENDS = np.array([_FAR, -0.1, -0.05, 0.01, 0.02, *(8 + _AROUND) * (0.03,)])  # of sliders, or squinting too
_CREASE = 5  # the first ring beyond the margin
_SOFT = 0.01  # cm, over which points begin to be pushed
_SPREAD = 12  # rounds in which a push spreads to the skin beside it
_CELLS, _SIDE = 128, 1.5  # of a table of an eyeball: stereographic coordinates about its front, to plus and minus 1.5
_NEAREST = 3  # points of the eyeball that say how far it reaches in a direction


@dataclass(frozen=True, kw_only=True)
class Ends:
    """What e sliders do at their ends to the k points of an eye's lids, and to its eyeball."""

    lids: FloatArray  # (e, k, 3) cm, without what joints do
    ball: FloatArray  # (e, 4) cm that its middle goes, and what is added to its scale
    joints: FloatArray  # (e, 2) cm that the joints of both lids go up, and what is added to their scale along y


@dataclass(frozen=True, kw_only=True)
class Socket:
    """What the eyes of a side have in common: k points of lids, and maybe around them, and the average eyeball."""

    lids: IntArray  # (k,) points
    rings: IntArray  # (k,)
    ball: slice  # points of the eyeball
    centre: FloatArray  # (3,)
    reach: FloatArray  # (_CELLS, _CELLS) cm from the middle of the eyeball
    turns: Mapping[str, FloatArray]  # look -> rotations (2, 3, 3) at 1 and at a half
    beside: csr_array  # (k, k) the mean over the points beside each
    joints: IntArray  # (2,) of the upper lid and the lower
    shares: FloatArray  # (2, k) their skin weights
    ends: Ends

    @classmethod
    def of(cls, side: str, ends: Callable[[str, IntArray], Ends], *, around: bool = False) -> Socket:
        """The left or the right one.

        :param ends: by side and lids
        :param around: with the skin around lids
        """
        head, data, number = asset(), arrays("lids"), SIDES.index(side)
        lids, rings = data["lids"][number], data["lid_rings"]
        if around:
            lids, rings = _with_skin(lids, rings)
        centre, reach = _eyeball(side)
        names = [path.rpartition("/")[2] for path in head.joints]
        joints = np.array([names.index(f"{lid}{side}") for lid in ("lidUpper", "lidLower")])
        own = head.skin_joints[lids] == joints[:, None, None]
        return cls(
            lids=lids,
            rings=rings,
            ball=head.parts[f"Eyeball{side}"].points,
            centre=centre,
            reach=reach,
            turns={name: _turns(x, y * (1 - 2 * number)) for name, (x, y) in LOOKS.items()},
            beside=_beside(lids),
            joints=joints,
            shares=(head.skin_weights[lids] * own).sum(axis=-1),
            ends=ends(side, lids),
        )


@cache
def _eyeball(side: str) -> tuple[FloatArray, FloatArray]:
    """The middle (3,) of an average eyeball, and the table of how far it reaches."""
    head = asset()
    centre = fit_ball(head.points[head.parts[f"Eyeball{side}"].points]).centre
    return centre, _reach(head.points[arrays("lids")["eye_shells"][SIDES.index(side)]] - centre)


def _with_skin(lids: IntArray, rings: IntArray) -> tuple[IntArray, IntArray]:
    """Points (k,) of lids and their rings, and those of `_AROUND` rings more."""
    links = asset().links
    for ring in range(_RINGS, _RINGS + _AROUND):
        beyond = np.setdiff1d(np.flatnonzero(links[:, lids[rings == ring - 1]].sum(axis=1)), lids)
        lids, rings = np.append(lids, beyond), np.append(rings, np.full(len(beyond), ring))
    return lids, rings


def _reach(offsets: FloatArray) -> FloatArray:
    """Table of how far the outside (n, 3) of an eyeball reaches: searches in a tree take 20 times as long.

    Places in it are stereographic: the sphere as its rearmost point sees it, without a pole before the eye.
    """
    radii = np.linalg.norm(offsets, axis=1)
    x, y = np.meshgrid(*2 * (np.linspace(-_SIDE, _SIDE, _CELLS),))
    scale = 2.0 / (1.0 + x**2 + y**2)
    directions = np.stack([x * scale, y * scale, scale - 1.0], axis=-1)
    away, near = cKDTree(offsets / radii[:, None]).query(directions, k=_NEAREST)
    weights = 1.0 / (away + 1e-3)
    return np.asarray((weights * radii[near]).sum(axis=-1) / weights.sum(axis=-1))


def _turns(about_x: float, about_y: float) -> FloatArray:
    """Rotations (2, 3, 3) at 1 and at a half; one of the angles is 0."""
    found = []
    for weight in (1.0, _HALF):
        (a, b), (c, d) = ((np.cos(weight * angle), np.sin(weight * angle)) for angle in (about_x, about_y))
        found.append(np.array([[1, 0, 0], [0, a, -b], [0, b, a]]) @ np.array([[c, 0, d], [0, 1, 0], [-d, 0, c]]))
    return np.stack(found)


def _beside(lids: IntArray) -> csr_array:
    """(k, k) the mean over the points beside each of the points (k,) of the head; those of no lid count as 0."""
    links = (asset().links[lids] > 0).astype(np.float64)
    return csr_array(links / links.sum(axis=1)[:, None])[:, lids]


@dataclass(frozen=True, kw_only=True)
class Eye:
    """An eye of a person."""

    socket: Socket
    centre: FloatArray  # (3,) of the eyeball
    scale: float  # of the average one
    lids: FloatArray  # (k, 3) at rest
    joints: FloatArray  # (2,) heights of the joints of the upper lid and the lower

    @classmethod
    def of(cls, socket: Socket, points: FloatArray, heights: FloatArray | None = None) -> Eye:
        """That of a person whose head has points (n, 3) in centimetres.

        :param heights: (j,) of the head's joints, where they are not where the points have them
        """
        head, own = asset(), points[socket.ball]
        average = head.points[socket.ball]
        scale = float(own.std(axis=0).sum() / average.std(axis=0).sum())
        if heights is None:
            heights = np.einsum("jk,jk->j", head.joint_shares, points[head.joint_points, 1])
        return cls(
            socket=socket,
            centre=own.mean(axis=0) - scale * (average.mean(axis=0) - socket.centre),
            scale=scale,
            lids=points[socket.lids],
            joints=heights[socket.joints],
        )

    def cleared(self) -> FloatArray:
        """(k, 3) lids at rest that stay before the eyeball at the ends of sliders: the crease of a deep upper lid does
        not, where the lid is drawn down."""
        ahead = np.eye(3)
        need = self._need_at_ends(np.zeros_like(self.lids), ahead)
        push = least = np.where(self.socket.rings < _CREASE, 0.0, np.maximum(need, 0.0))
        for _ in range(_SPREAD):
            push = np.maximum(least, self.socket.beside @ push)
        return self.lids + self._out(np.zeros_like(self.lids), push)

    def fitted(self, shapes: Mapping[str, Mapping[float, FloatArray]]) -> dict[str, dict[float, FloatArray]]:
        """Looks and the squint that keep lids before the eyeball: shape -> weight -> (k, 3) offsets."""
        found: dict[str, dict[float, FloatArray]] = {}
        ahead = np.eye(3)
        for name, (turned, half) in self.socket.turns.items():
            way, middle = shapes[name][1.0], shapes[name].get(_HALF)
            # a shape may be played without a turn
            need = np.maximum(self._need(way, ahead), self._need(way, turned))
            need = np.maximum(need, self._need_at_ends(way, turned))
            need_at_half = self._need(_HALF * way if middle is None else middle, half)
            if middle is None:
                need = np.maximum(need, need_at_half / _HALF)
            push = self._spread(need)
            found[name] = {1.0: way + self._out(way, push)}
            if middle is not None:
                push = self._spread(np.maximum(need_at_half, _HALF * push))
                found[name] = {_HALF: middle + self._out(middle, push), **found[name]}
        way = shapes[SQUINT][1.0]
        need = np.maximum(self._need(way, ahead), self._need_at_ends(way, ahead))
        for name, (turned, _) in self.socket.turns.items():
            need = np.maximum(need, self._need(way + found[name][1.0], turned, _LEAST_AT_ENDS))
        found[SQUINT] = {1.0: way + self._out(way, self._spread(need))}
        return found

    def _need(self, way: FloatArray, turn: FloatArray, least: FloatArray = _LEAST) -> FloatArray:
        """(k,) cm that lids lack over the turned eyeball where they go `way` (k, 3)."""
        return self._lack(self.lids + way - self.centre, turn, np.array(self.scale), least)

    def _need_at_ends(self, way: FloatArray, turn: FloatArray) -> FloatArray:
        """(k,) the most that they lack at an end of any slider."""
        ends, shares = self.socket.ends, self.socket.shares
        moved = self.lids + way + ends.lids
        stretch = ends.joints[:, None, None, 0] + ends.joints[:, None, None, 1] * (
            moved[:, None, :, 1] - self.joints[:, None]
        )
        moved[..., 1] += (shares * stretch).sum(axis=1)
        size = self.scale * (1.0 + ends.ball[:, 3:])
        lack = self._lack(moved - self.centre - ends.ball[:, None, :3], turn, size, _LEAST_AT_ENDS)
        return np.asarray(lack.max(axis=0))

    def _lack(self, offsets: FloatArray, turn: FloatArray, scale: FloatArray, least: FloatArray) -> FloatArray:
        """(..., k) of offsets (..., k, 3) from the middle of the eyeball."""
        lengths = np.sqrt((offsets**2).sum(axis=-1))
        directions = (offsets / lengths[..., None]) @ turn  # back into the eyeball that looks ahead
        flat = directions[..., :2] / (1.0 + np.maximum(directions[..., 2:], -0.5))
        place = np.clip((flat + _SIDE) * ((_CELLS - 1) / (2 * _SIDE)), 0.0, _CELLS - 1.001)
        cell = place.astype(np.intp)
        s, t = np.moveaxis(place - cell, -1, 0)
        first, reach = cell[..., 1] * _CELLS + cell[..., 0], self.socket.reach.ravel()
        low, high = ((1 - s) * reach[first + row] + s * reach[first + row + 1] for row in (0, _CELLS))
        return np.asarray(least[self.socket.rings] + scale * ((1 - t) * low + t * high) - lengths)

    def _spread(self, need: FloatArray) -> FloatArray:
        """(k,) pushes of at least the need, as smooth as a skin drawn over them."""
        push = least = _SOFT * np.logaddexp(0.0, need / _SOFT)
        for _ in range(_SPREAD):
            push = np.maximum(least, self.socket.beside @ push)
        return np.asarray(push)

    def _out(self, way: FloatArray, push: FloatArray) -> FloatArray:
        offsets = self.lids + way - self.centre
        return np.asarray(offsets * (push / np.linalg.norm(offsets, axis=1))[:, None])
