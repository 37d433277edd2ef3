"""Which side of the mouth and of the eyes a head's points are on, by the head's own connections.

Lips and lids lie closer to each other than a fit is exact: the nearest place of the template may be on the other one.
What is well above or below a slit is not in doubt, and from there distances along the head's own surface decide, round
the corners of the slit and never across it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.geometry.geodesics import graph_distances, surface_graph
from facepipe.scanning.rebuild.template import Template
from facepipe.scanning.transfer.mesh import HeadMesh
from facepipe.scanning.transfer.places import Places
from facepipe.verbs.skin.surface import slits_of

_SURE = (0.12, 0.45)  # of a slit's width from its rims: there points are on a side without doubt
_BESIDE = 0.3  # of a slit's width: difference of the distances from its rims, up to which a point is beside a corner
_ASIDE = 0.1  # of a slit's width: difference of distances from the two sides that is none
_NEAR = 0.35  # of a slit's width from the rims, into the head: so far sides count
_THERE = 1e-9  # share of a corner in a place that is none


class Banks(NamedTuple):
    """The outside of the template's skin above and below a slit."""

    above: BoolArray  # (r,) rows
    below: BoolArray  # (r,)
    away: FloatArray  # (r,) from the nearer rim, of the slit's width
    corners: tuple[int, int]  # rows


def banks_of(template: Template) -> list[Banks]:
    """Those of the mouth, the right eye and the left one."""
    surface = template.surface
    sewn = surface.group[template.rows]
    seen = np.zeros(len(sewn), bool)
    seen[template.seen] = True
    found = []
    for slit, ends in zip(slits_of(surface), ((60, 64), (36, 39), (42, 45)), strict=True):
        side, away = slit.side[sewn], slit.distance[sewn] / slit.width
        corners = int(template.landmarks[ends[0]]), int(template.landmarks[ends[1]])
        found.append(Banks(above=seen & (side > _BESIDE), below=seen & (side < -_BESIDE), away=away, corners=corners))
    return found


def sides_on(
    template: Template, rows: FloatArray, head: HeadMesh, places: Places, reach: float
) -> tuple[IntArray, IntArray]:
    """(r,) and (s,) which side of a slit points of the fitted template and of the head are on: +a and -a above and
    below slit a, 0 neither.

    Both by one measure, so that they are the same where the meshes are.

    :param rows: (r, 3) where the template's rows lie on the head
    :param places: of the head's points on these
    :param reach: mm, up to which a place says where a point is
    """
    cells = np.pad(template.triangles, ((0, 0), (0, 1)), constant_values=-1)
    graph, trusted = surface_graph(rows, cells), places.distances <= reach
    seen = np.zeros(len(rows), bool)
    seen[template.seen] = True
    own, found = np.zeros(len(rows), np.int64), np.zeros(len(head.points), np.int64)
    for number, bank in enumerate(banks_of(template), start=1):
        width = float(np.linalg.norm(np.subtract(*rows[list(bank.corners)])))
        away = np.where(np.isfinite(bank.away), bank.away, _SURE[1] + 1.0)
        _label(graph, own, number, bank[:2], away, seen, width)
        banks = [trusted & (one[places.corners] | (places.shares <= _THERE)).all(axis=1) for one in bank[:2]]
        _label(head.graph, found, number, banks, places.of(away), trusted & seen[places.corners].any(axis=1), width)
    return own, found


def _label(
    graph: Any,
    labels: IntArray,
    number: int,
    banks: Sequence[BoolArray],
    away: FloatArray,
    outside: BoolArray,
    width: float,
) -> None:
    """Write +`number` and -`number` to the points that are nearer to the one bank or the other.

    Ways begin at points `away` from the rims by `_SURE` and count from the farthest of these on, so that it does not
    matter which of them a coarse mesh has.
    """
    sure = (away >= _SURE[0]) & (away <= _SURE[1])
    seeds = [np.flatnonzero(bank & sure) for bank in banks]
    if not all(map(len, seeds)):
        return
    above, below = graph_distances(graph, seeds, [width * (_SURE[1] - away[one]) for one in seeds]) / width
    near = (np.minimum(above, below) <= _SURE[1] + _NEAR) & ((away <= _SURE[1]) | ~outside)
    apart = np.where(near, below, 0.0) - np.where(near, above, 0.0)  # infinite where one lip is a piece by itself
    sided = np.abs(apart) > _ASIDE
    labels[sided] = number * np.sign(apart[sided]).astype(np.int64)
