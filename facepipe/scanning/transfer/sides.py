"""Which side of the mouth and of the eyes a head's points are on, by the head's own connections.

Lips and lids lie closer to each other than a fit is exact: the nearest place of the template may be on the other one.
What is well above or below a slit is not in doubt, and from there distances along the head's own surface decide, round
the corners of the slit and never across it.
"""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import BoolArray, IntArray
from facepipe.geometry.geodesics import graph_distances
from facepipe.scanning.rebuild.template import Template
from facepipe.scanning.transfer.fit import HeadMesh
from facepipe.verbs.skin.surface import slits_of, surface_of

_SURE = (0.12, 0.45)  # of a slit's width: so far from its rims points are on a side without doubt
_ASIDE = 0.1  # of a slit's width: difference of distances from the two sides that is none
_NEAR = 0.35  # of a slit's width from the rims: so far sides count


def head_sides(template: Template, head: HeadMesh, corners: IntArray, trusted: BoolArray) -> IntArray:
    """(s,) +a and -a for points of the upper and lower side of slit a, 0 for neither, as `Template.labels`.

    :param corners: (s, 3) rows of the template that each point of the head is nearest to
    :param trusted: (s,) whether they are near
    """
    surface = surface_of(template.parts, template.where)
    sewn = surface.group[template.rows]
    seen = np.zeros(len(sewn), bool)
    seen[template.seen] = True
    labels = np.zeros(len(head.points), np.int64)
    for number, slit in enumerate(slits_of(surface), start=1):
        side, away = slit.side[sewn], slit.distance[sewn] / slit.width
        sure = seen & (away >= _SURE[0]) & (away <= _SURE[1]) & (np.abs(side) > _ASIDE)
        seeds = [np.flatnonzero(trusted & (sure & (sign * side > 0))[corners].all(axis=1)) for sign in (1, -1)]
        if not all(map(len, seeds)):
            continue
        above, below = graph_distances(head.graph, seeds)
        near = np.minimum(above, below) <= (_SURE[0] + _NEAR) * slit.width
        apart = np.zeros(len(labels))
        apart[near] = np.clip((below - above)[near] / slit.width, -1.0, 1.0)
        labels = np.where(near & (np.abs(apart) > _ASIDE), number * np.sign(apart).astype(np.int64), labels)
    return labels
