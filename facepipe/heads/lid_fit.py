"""Lids that follow gaze: looks and squints that keep the lids of a person before the eyeballs.

Linear shapes of lids were made on one eyeball that did not turn. Of others, a turned cornea and a white that is not
round come through lids, the more so where a slider has moved or widened the eye. Points of lids that would lie inside
the eyeball in one of these poses are pushed out along its radius, and the skin beside them a little less.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.heads.asset import asset
from facepipe.payload.lid_tables import RINGS, EyeTables, LidTables

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
_AROUND = 5  # rings farther out than lids': at rest the skin around them counts too
# by ring, cm over the eyeball
_LEAST = np.array([_FAR, 0.0, 0.02, 0.06, 0.10, 0.12, 0.12, 0.12, 0.12, 0.12, 0.10, _FAR, _FAR])
_LEAST_AT_ENDS = np.array([_FAR, -0.1, -0.05, 0.01, 0.02, *(8 + _AROUND) * (0.03,)])  # of sliders, or squinting too
_CREASE = 5  # the first ring beyond the margin
_SOFT = 0.01  # cm, over which points begin to be pushed
_SPREAD = 12  # rounds in which a push spreads to the skin beside it
REACH_SIDE = 1.5  # a table of an eyeball goes to plus and minus that, in stereographic coordinates about its front
_CM = 0.1  # of a millimetre


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
    upper: npt.NDArray[np.bool_]  # (k,); False around
    corners: IntArray  # (2,) rows of lids
    ball: slice  # points of the eyeball
    centre: FloatArray  # (3,)
    shell: cKDTree  # directions of the eyeball's outside from its middle
    radii: FloatArray  # and how far that is
    reach: FloatArray  # (c, c) cm from the middle of the eyeball to its outside
    turns: Mapping[str, FloatArray]  # look -> rotations (2, 3, 3) at 1 and at a half
    beside: csr_array  # (k, k) the mean over the points beside each; those of no lid count as 0
    joints: IntArray  # (2,) of the upper lid and the lower
    shares: FloatArray  # (2, k) their skin weights
    ends: Ends

    def lack(self, offsets: FloatArray, turn: FloatArray, scale: FloatArray, least: FloatArray) -> FloatArray:
        """(..., k) cm that offsets (..., k, 3) from the middle of a turned eyeball lack to lie over it, by rings."""
        lengths = np.sqrt((offsets**2).sum(axis=-1))
        directions = (offsets / lengths[..., None]) @ turn  # back into the eyeball that looks ahead
        cells = len(self.reach)
        flat = directions[..., :2] / (1.0 + np.maximum(directions[..., 2:], -0.5))
        place = np.clip((flat + REACH_SIDE) * ((cells - 1) / (2 * REACH_SIDE)), 0.0, cells - 1.001)
        cell = place.astype(np.intp)
        s, t = np.moveaxis(place - cell, -1, 0)
        first, reach = cell[..., 1] * cells + cell[..., 0], self.reach.ravel()
        low, high = ((1 - s) * reach[first + row] + s * reach[first + row + 1] for row in (0, cells))
        return np.asarray(least[self.rings] + scale * ((1 - t) * low + t * high) - lengths)

    def with_skin(self, side: str, ends: Callable[[str, IntArray], Ends]) -> Socket:
        """With the skin around lids.

        :param ends: by side and lids
        """
        head, lids, rings = asset(), self.lids, self.rings
        for ring in range(RINGS, RINGS + _AROUND):
            beyond = np.setdiff1d(np.flatnonzero(head.links[:, lids[rings == ring - 1]].sum(axis=1)), lids)
            lids, rings = np.append(lids, beyond), np.append(rings, np.full(len(beyond), ring))
        links = (head.links[lids] > 0).astype(np.float64)
        own = head.skin_joints[lids] == self.joints[:, None, None]
        return replace(
            self,
            lids=lids,
            rings=rings,
            upper=np.append(self.upper, np.zeros(len(lids) - len(self.lids), bool)),
            beside=csr_array(links / links.sum(axis=1)[:, None])[:, lids],
            shares=(head.skin_weights[lids] * own).sum(axis=-1),
            ends=ends(side, lids),
        )


@cache
def sockets() -> tuple[Socket, ...]:
    """The left and the right one."""
    tables = asset().basis.lids
    assert tables is not None  # samples/head/lid_tables.py adds them
    return tuple(_socket(tables, number) for number in range(len(SIDES)))


def _socket(tables: LidTables, number: int) -> Socket:
    eye: EyeTables = tables.eyes[number]
    count, sizes = len(eye.lids), [len(rows) for rows in tables.beside]
    shares = np.repeat(1.0 / tables.links, sizes)
    starts = np.append(0, np.cumsum(sizes))
    offsets = _CM * (asset().basis.mean[eye.shell] - eye.centre)
    radii = np.linalg.norm(offsets, axis=1)
    ends = np.concatenate([-eye.ends, eye.ends]), np.concatenate([-eye.balls, eye.balls])
    return Socket(
        lids=eye.lids,
        rings=tables.rings,
        upper=tables.upper,
        corners=np.array(tables.corners),
        ball=slice(*eye.ball),
        centre=_CM * eye.centre,
        shell=cKDTree(offsets / radii[:, None]),
        radii=radii,
        reach=_CM * (tables.reach[:, ::-1] if number else tables.reach),
        turns={name: _turns(x, y * (1 - 2 * number)) for name, (x, y) in LOOKS.items()},
        beside=csr_array((shares, np.concatenate(tables.beside), starts), shape=(count, count)),
        joints=np.array(eye.joints),
        shares=eye.shares,
        ends=Ends(
            lids=_CM * ends[0],
            ball=ends[1] * [_CM, _CM, _CM, 1.0],
            joints=np.concatenate([-eye.stretches, eye.stretches]) * [_CM, 1.0],
        ),
    )


def _turns(about_x: float, about_y: float) -> FloatArray:
    """Rotations (2, 3, 3) at 1 and at a half; one of the angles is 0."""
    found = []
    for weight in (1.0, _HALF):
        (a, b), (c, d) = ((np.cos(weight * angle), np.sin(weight * angle)) for angle in (about_x, about_y))
        found.append(np.array([[1, 0, 0], [0, a, -b], [0, b, a]]) @ np.array([[c, 0, d], [0, 1, 0], [-d, 0, c]]))
    return np.stack(found)


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
        return self.socket.lack(self.lids + way - self.centre, turn, np.array(self.scale), least)

    def _need_at_ends(self, way: FloatArray, turn: FloatArray) -> FloatArray:
        """(k,) the most that they lack at an end of any slider."""
        ends, shares = self.socket.ends, self.socket.shares
        moved = self.lids + way + ends.lids
        stretch = ends.joints[:, None, None, 0] + ends.joints[:, None, None, 1] * (
            moved[:, None, :, 1] - self.joints[:, None]
        )
        moved[..., 1] += (shares * stretch).sum(axis=1)
        size = self.scale * (1.0 + ends.ball[:, 3:])
        lack = self.socket.lack(moved - self.centre - ends.ball[:, None, :3], turn, size, _LEAST_AT_ENDS)
        return np.asarray(lack.max(axis=0))

    def _spread(self, need: FloatArray) -> FloatArray:
        """(k,) pushes of at least the need, as smooth as a skin drawn over them."""
        push = least = _SOFT * np.logaddexp(0.0, need / _SOFT)
        for _ in range(_SPREAD):
            push = np.maximum(least, self.socket.beside @ push)
        return np.asarray(push)

    def _out(self, way: FloatArray, push: FloatArray) -> FloatArray:
        offsets = self.lids + way - self.centre
        return np.asarray(offsets * (push / np.linalg.norm(offsets, axis=1))[:, None])
