"""What landmarks of a scan show shut: eyes, which a neutral has open, and lips, whose rims a scan does not show."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.geodesics import graph_distances
from facepipe.scanning.rebuild.template import Template
from facepipe.scans import ScanLandmarks
from facepipe.verbs.skin.features import points_between, smoothstep
from facepipe.verbs.skin.surface import surface_of

_SHUT = 0.21  # of an eye's width, that lids' landmarks are apart; those found on a real scan's shut eyes are 0.2
_SEALED = 0.03  # of the mouth's width, that lips' landmarks are apart
_UPPER, _LOWER = (60, 61, 62, 63, 64), (60, 67, 66, 65, 64)  # the lips' inner landmarks, from corner to corner
_LIPS = 0.16  # of the mouth's width: so far from their rims, lips follow these
_WIDE = 0.12  # of the mouth's width: lips that are farther apart are not sealed


def shut_eyes(landmarks: ScanLandmarks, shapes: Collection[str]) -> dict[str, float]:
    """The blinks among a face's shapes of the eyes whose lids' landmarks meet, with weight 1."""
    shut = {}
    for side, first in (("Left", 42), ("Right", 36)):
        outer, *upper, inner, low_inner, low_outer = landmarks.points[first : first + 6]
        apart = sum(np.linalg.norm(one - low) for one, low in zip(upper, (low_outer, low_inner), strict=True))
        name = next((name for name in (f"eyeBlink{side}", f"eyeBlink_{side[0]}") if name in shapes), None)
        if name is not None and apart < 2 * _SHUT * np.linalg.norm(inner - outer):  # not where one is unknown
            shut[name] = 1.0
    return shut


def are_sealed(landmarks: ScanLandmarks) -> bool:
    """Whether the landmarks of both lips meet; not where one is unknown."""
    upper, lower = (landmarks.points[list(rim)] for rim in (_UPPER, _LOWER))
    width = np.linalg.norm(upper[-1] - upper[0])
    return bool(np.linalg.norm(upper - lower, axis=1)[1:-1].mean() < _SEALED * width)


def with_sealed_lips(template: Template, points: FloatArray) -> FloatArray:
    """Whole points (n, 3) with both rims of the lips halfway between where they are, and the lips drawn after them.

    The rims of sealed lips lie in a crease, where no point of the scan faces as they do.
    """
    surface = surface_of(template.parts, template.where)
    assert surface.landmarks is not None
    rims = [points_between(surface, surface.landmarks[list(marks)]) for marks in (_UPPER, _LOWER)]
    above, below = graph_distances(surface.graph, rims)[:, surface.group]
    start, end = points[template.rows[template.landmarks[[_UPPER[0], _UPPER[-1]]]]]
    width = float(np.linalg.norm(end - start))
    along = (points - start) @ (end - start) / width**2
    upper, lower = (_on_rim(points, along, np.flatnonzero(np.isin(surface.group, rim))) for rim in rims)
    gap = upper - lower
    # Across the mouth alone: a rim found a little too far along would draw the lips sideways.
    gap -= np.outer(gap @ (end - start), end - start) / width**2
    if np.linalg.norm(gap, axis=1).max() > _WIDE * width:
        return points
    share = 1.0 - smoothstep(np.minimum(above, below) / (_LIPS * width))
    way = 0.5 * share * ((below < above) * 1.0 - (above < below) * 1.0)
    return np.asarray(points + way[:, None] * gap)


def _on_rim(points: FloatArray, along: FloatArray, rim: IntArray) -> FloatArray:
    """(n, 3) where a rim is, as far along the mouth as each point (n, 3)."""
    rim = rim[np.argsort(along[rim], kind="stable")]
    return np.stack([np.interp(along, along[rim], column) for column in points[rim].T], axis=1)
