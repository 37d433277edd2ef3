"""The rims of a head's own eyes and mouth, and where those of the template belong on them.

A fit to the surface slides along it: lids end where the template's do, and not where the head's are. A rim is the
envelope of its lid: of all points of the upper one the lowest, as far along from corner to corner as each. It is found
alike on holes, on lids that turn into sockets and on coarse meshes, on the head as on the template. Rims are laid on
one another up and out, each place as far along as the fit has it: laid by shares of the way between the corners of
their own openings, which end at tear corners and on coarse meshes anywhere, they were off by 1 to 2 mm along and 0.5 to
1.5 mm up on heads whose rims are known, and as they are by 0.05 to 0.4 mm up.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.geometry.polygons import edges
from facepipe.geometry.registration import Anchors
from facepipe.geometry.vectors import unit_vectors
from facepipe.scanning.rebuild.template import Template
from facepipe.scanning.transfer.mesh import HeadMesh

# landmarks of multipie68 of each slit: from corner to corner along the upper rim, and along the lower one
RIMS = (
    ((60, 61, 62, 63, 64), (60, 67, 66, 65, 64)),
    ((36, 37, 38, 39), (36, 41, 40, 39)),
    ((42, 43, 44, 45), (42, 47, 46, 45)),
)
_STATIONS = np.linspace(-0.15, 1.15, 131)  # of the way from corner to corner
_SHARES = np.linspace(0.08, 0.92, 8)  # of an opening, where rims are laid on one another
_DEPTH, _HEIGHT = 0.2, 0.6  # of a slit's width: so far from the fitted landmarks a rim is looked for
_OPEN = 0.02  # of a slit's width: lids or lips that are nearer to each other have no opening between them
_LEAST_WIDTH = 0.6  # of the template's opening: one that is shorter is a hole in it
_SIGMA_MM, _SIGMA_OF_EDGE = 0.3, 0.15  # how far off a rim may be: at least, and of the head's edges there


class Frame(NamedTuple):
    """Axes of a slit: along from corner to corner, up, and out of the face, in its width."""

    origin: FloatArray  # (3,)
    axes: FloatArray  # (3, 3) rows
    width: float
    rim: FloatArray  # (k, 3) the fitted landmarks in these, ascending along

    @classmethod
    def of(cls, marks: FloatArray, upper: tuple[int, ...], lower: tuple[int, ...]) -> Frame:
        """That of fitted landmarks (68, 3)."""
        start, end = marks[upper[0]], marks[upper[-1]]
        width = max(float(np.linalg.norm(end - start)), np.finfo(np.float64).tiny)
        along = (end - start) / width
        up = marks[list(range(27, 31))].mean(axis=0) - marks[8]  # from the chin to the nose
        up = unit_vectors((up - (up @ along) * along)[None])[0]
        axes = np.stack([along, up, np.cross(along, up)])
        local = (marks[[*upper, *lower[1:-1]]] - start) @ axes.T / width
        return cls(origin=start, axes=axes, width=width, rim=local[np.argsort(local[:, 0], kind="stable")])

    def local(self, points: FloatArray) -> FloatArray:
        """(n, 3) in these axes."""
        return np.asarray((points - self.origin) @ self.axes.T / self.width)


class Lid(NamedTuple):
    """Edges of one lid or lip near its rim."""

    ends: IntArray  # (e, 2) points
    places: FloatArray  # (e, 2, 3) of these, in a slit's axes
    sign: int  # 1 of an upper one, whose rim is the lowest of it

    @classmethod
    def of(cls, local: FloatArray, pairs: IntArray, labels: IntArray, number: int, frame: Frame) -> Lid:
        """Those of label `number`, or with one end of it, and the other at a corner."""
        along, _, depth = frame.rim.T
        away = np.abs(local[:, 2] - np.interp(local[:, 0], along, depth))
        middle = frame.rim[:, 1].mean()
        near = (away <= _DEPTH) & (np.abs(local[:, 1] - middle) <= _HEIGHT)
        own = labels == number
        kept = near[pairs].all(axis=1) & own[pairs].any(axis=1) & (own | (labels == 0))[pairs].all(axis=1)
        return cls(ends=pairs[kept], places=local[pairs[kept]], sign=int(np.sign(number)))

    def envelope(self, stations: FloatArray) -> tuple[IntArray, FloatArray, FloatArray]:
        """Edge (k,), -1 for none, share of its end (k,) and height (k,) of the rim at each station."""
        if not len(self.ends):
            return np.full(len(stations), -1), np.zeros(len(stations)), np.full(len(stations), np.nan)
        start, end = self.places[:, 0], self.places[:, 1]
        run = end[:, 0] - start[:, 0]
        share = (stations[:, None] - start[:, 0]) / np.where(np.abs(run) > 1e-9, run, np.inf)
        height = start[:, 1] + share * (end[:, 1] - start[:, 1])
        over = (np.minimum(start[:, 0], end[:, 0]) <= stations[:, None]) & (
            np.maximum(start[:, 0], end[:, 0]) >= stations[:, None]
        )
        order = np.where(over, self.sign * height, np.inf)
        edge, rows = order.argmin(axis=1), np.arange(len(stations))
        there = over[rows, edge]
        return np.where(there, edge, -1), share[rows, edge], np.where(there, height[rows, edge], np.nan)


def opening(lids: tuple[Lid, Lid]) -> tuple[float, float] | None:
    """From where to where there is something between an upper and a lower lid; None: nowhere in the middle."""
    gap = lids[0].envelope(_STATIONS)[2] - lids[1].envelope(_STATIONS)[2]
    shut = np.flatnonzero(~(gap > _OPEN))
    middle = len(_STATIONS) // 2
    if middle in shut:
        return None
    first = shut[shut < middle].max(initial=-1) + 1
    last = shut[shut > middle].min(initial=len(_STATIONS)) - 1
    return float(_STATIONS[first]), float(_STATIONS[last])


def rim_anchors(template: Template, rows: FloatArray, head: HeadMesh, labels: IntArray, sides: IntArray) -> Anchors:
    """Places of the template's rims with where they belong on the head.

    :param rows: (r, 3) of the fitted template
    :param labels: (r,) and `sides` (s,) of the template and of the head, as `sides_on` finds them
    """
    seen = np.zeros(len(rows), bool)
    seen[template.seen] = True
    skin = template.triangles[seen[template.triangles].all(axis=1)]  # lids, without the sockets that they run into
    meshes = ((rows, skin, labels), (head.points, head.triangles, sides))
    pairs = [edges(np.full(len(triangles), 3), triangles.ravel())[0] for _, triangles, _ in meshes]
    found = Anchors.at_points(np.zeros(0, np.int64), np.zeros((0, 3)))
    for number, (upper, lower) in enumerate(RIMS, start=1):
        frame = Frame.of(rows[template.landmarks], upper, lower)
        own, other = (
            [Lid.of(frame.local(points), ends, marked, sign * number, frame) for sign in (1, -1)]
            for (points, _, marked), ends in zip(meshes, pairs, strict=True)
        )
        ours, theirs = opening((own[0], own[1])), opening((other[0], other[1]))
        if ours is None or theirs is None or np.ptp(theirs) < _LEAST_WIDTH * np.ptp(ours):
            continue
        first, last = max(ours[0], theirs[0]), min(ours[1], theirs[1])
        stations = first + _SHARES * (last - first)
        for lid, their_lid in zip(own, other, strict=True):
            found = found.with_more(_laid(lid, their_lid, stations, head.points))
    return found


def _laid(ours: Lid, theirs: Lid, stations: FloatArray, points: FloatArray) -> Anchors:
    """The template's rim with the head's, at the same stations."""
    (edge, share, _), (other, there, _) = ours.envelope(stations), theirs.envelope(stations)
    known: BoolArray = (edge >= 0) & (other >= 0)
    edge, share, other, there = edge[known], share[known], other[known], there[known]
    starts, ends = points[theirs.ends[other]].transpose(1, 0, 2)
    lengths = np.linalg.norm(ends - starts, axis=1)
    return Anchors(
        corners=ours.ends[edge][:, [0, 1, 1]],
        shares=np.stack([1.0 - share, share, np.zeros(len(share))], axis=1),
        targets=starts + there[:, None] * (ends - starts),
        names=("rim",) * len(share),
        sigmas=np.maximum(_SIGMA_MM, _SIGMA_OF_EDGE * lengths),
    )
