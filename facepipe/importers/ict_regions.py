"""Soft regions of the ICT-FaceKit head.

Loose parts and the sockets belong to one region whole (`ict_topology.PARTS`). On the rest of the head each region is
a bundle of polylines with a radius, on the generic neutral: through landmarks where there are some, otherwise through
points given in centimetres. A point's distance to a region is the distance to its polylines less the radius, and its
mask ``softmax(-distance / BLEND)``: about 1 inside, an even mix halfway between two regions, 1 in sum everywhere.
Forehead takes in the whole cranium, neck the nape and shoulders.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.geometry.vectors import to_segment
from facepipe.importers.ict_topology import LANDMARKS, PARTS

BLEND = 0.35  # cm

Spot = int | tuple[float, float, float]  # a landmark's position in the list of 68, or a place in cm


class Bundle(NamedTuple):
    """Polylines and their radius in centimetres."""

    radius: float
    lines: tuple[tuple[Spot, ...], ...]


BUNDLES: dict[str, Bundle] = {
    "forehead": Bundle(
        8.0,
        (((0.0, 7.6, 2.2), (0.0, 6.0, -1.0), (0.0, 4.0, -1.8)),),
    ),
    "eyebrows": Bundle(0.85, ((17, 18, 19, 20, 21), (26, 25, 24, 23, 22))),
    "eyes": Bundle(1.0, ((36, 37, 38, 39, 40, 41, 36), (42, 43, 44, 45, 46, 47, 42), (36, 39), (42, 45))),
    "nose": Bundle(1.0, ((27, 28, 29, 30, 33), (31, 30, 35), (31, 33, 35))),
    "mouth": Bundle(0.9, ((48, 49, 50, 51, 52, 53, 54, 55, 56, 57, 58, 59, 48), (60, 64))),
    "cheek": Bundle(
        1.9,
        (
            ((-4.4, -0.6, 9.0), (-4.6, -3.0, 8.4), (-5.0, -5.0, 6.5), (-6.2, -2.0, 4.6), (-6.4, 0.4, 4.6)),
            ((4.4, -0.6, 9.0), (4.6, -3.0, 8.4), (5.0, -5.0, 6.5), (6.2, -2.0, 4.6), (6.4, 0.4, 4.6)),
        ),
    ),
    "chin": Bundle(1.1, ((6, 7, 8, 9, 10), ((0.0, -6.0, 10.2), (0.0, -7.0, 9.8)))),
    "ears": Bundle(
        1.6,
        (((-8.0, 2.0, -0.6), (-7.8, -0.5, 0.4)), ((8.0, 2.0, -0.6), (7.8, -0.5, 0.4))),
    ),
    "neck": Bundle(
        6.2,
        (((0.0, -12.0, 0.0), (0.0, -20.0, 0.0)), ((0.0, -7.0, -3.0), (0.0, -14.0, -2.0))),
    ),
}

REGIONS = tuple(BUNDLES)


def head_regions(neutral: FloatArray) -> dict[str, FloatArray]:
    """Masks (h,) of the points of Head, summing to 1 at each.

    :param neutral: (points, 3) of the generic neutral, whatever the identity, so that masks never depend on it
    """
    count = max(part.points[1] for part in PARTS if part.mesh == "Head")
    landmarks = neutral[list(LANDMARKS)]
    distances = np.stack([_distance(neutral[:count], landmarks, bundle) for bundle in BUNDLES.values()])
    masks = np.exp(-(distances - distances.min(axis=0)) / BLEND)
    masks[masks < 0.01] = 0.0  # far regions are exactly absent
    masks /= masks.sum(axis=0)
    for part in PARTS:
        if part.mesh == "Head" and part.region:
            masks[:, slice(*part.points)] = np.array([name == part.region for name in REGIONS])[:, None]
    return dict(zip(REGIONS, masks, strict=True))


def _distance(points: FloatArray, landmarks: FloatArray, bundle: Bundle) -> FloatArray:
    places = [[landmarks[spot] if isinstance(spot, int) else np.array(spot) for spot in line] for line in bundle.lines]
    segments = [(a, b) for line in places for a, b in itertools.pairwise(line)]
    return np.asarray(np.min([to_segment(points, a, b) for a, b in segments], axis=0) - bundle.radius)
