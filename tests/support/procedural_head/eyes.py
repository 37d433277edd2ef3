"""The eye patch (lids with a thick rim and the socket behind) and the eyeballs.

Lids are placed in spherical coordinates around the eyeball: longitude from the front towards the outside of the
face, latitude upwards.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray
from procedural_head.identity import Identity

RIM = 6  # ring of the lid rim's front edge
RINGS = 10
_LID = 0.13  # thickness of the lids
_CLEARANCE = 0.035  # between eyeball and lids


@dataclass(frozen=True)
class Eye:
    """The left eyeball and its opening."""

    center: FloatArray  # (3,)
    radius: float
    opening: float  # factor on the lids' heights
    tilt: float  # radians, outer corner up


def eye(who: Identity) -> Eye:
    """The left eye of an identity."""
    return Eye(
        center=np.array([3.15 + 0.11 * who.eye_spacing, 0.0, 7.02]),
        radius=1.33 * (1 + 0.025 * who.eye_size),
        opening=1 + 0.09 * who.eye_opening,
        tilt=0.035 * who.eye_tilt,
    )


def to_sphere(points: FloatArray, center: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Longitude, latitude (radians) and distance of (..., 3) points around `center`."""
    offset = points - center
    distance = np.linalg.norm(offset, axis=-1)
    return np.arctan2(offset[..., 0], offset[..., 2]), np.arcsin(offset[..., 1] / distance), distance


def from_sphere(longitude: FloatArray, latitude: FloatArray, distance: FloatArray, center: FloatArray) -> FloatArray:
    """(..., 3) points from spherical coordinates around `center`."""
    flat = np.cos(latitude)
    direction = np.stack([flat * np.sin(longitude), np.sin(latitude), flat * np.cos(longitude)], axis=-1)
    return np.asarray(center + distance[..., None] * direction)


def rim_angles(shape: Eye, spokes: int) -> tuple[FloatArray, FloatArray]:
    """Longitude and latitude (spokes,) of the open lid rims: outer corner, upper lid, inner corner, lower lid."""
    half = spokes // 2
    index = np.arange(spokes)
    upper = index <= half
    across = np.where(upper, index, spokes - index) / half
    linear = 0.45 * np.cos(np.pi * across) + 0.55 * (1 - 2 * across)
    longitude = np.radians(-3 + 58 * linear)
    u = np.sin(np.pi * across**0.92) ** 0.8
    v = np.sin(np.pi * across**1.12) ** 0.85
    height = np.where(upper, 23.0 * u, -19.5 * v) * shape.opening
    corners = 2.5 * (1 - across) - 6.0 * across
    return longitude, np.radians(height + corners) + shape.tilt * np.sin(longitude)


def place_lids(outline: FloatArray, shape: Eye) -> FloatArray:
    """(rings + 1, spokes, 3) points of the left eye's patch; `outline` (spokes, 3) is its ring 0."""
    spokes = outline.shape[0]
    rim_lon, rim_lat = rim_angles(shape, spokes)
    lon, lat, distance = to_sphere(outline, shape.center)
    lid = shape.radius + _CLEARANCE + _LID
    share = np.array([0.0, 0.2, 0.4, 0.58, 0.75, 0.89, 1.0])[:, None]
    upper = (np.arange(spokes) <= spokes // 2)[None]
    fall = np.where(upper, 1.9, 1.45)
    radius = lid + (distance - lid) * (1 - share) ** fall
    crease = np.array([0.0, 0.02, 0.08, -0.20, -0.03, 0.02, 0.0])[:, None] * (
        np.sin(np.pi * np.arange(spokes) / (spokes // 2)).clip(0) ** 0.5
    )
    outer = from_sphere(lon + (rim_lon - lon) * share, lat + (rim_lat - lat) * share, radius + crease, shape.center)
    outer[0] = outline
    return np.concatenate([outer, _inside(rim_lon, rim_lat, shape)])


def _inside(lon: FloatArray, lat: FloatArray, shape: Eye) -> FloatArray:
    """(4, spokes, 3) the rim's back edge and the socket around and behind the eyeball."""
    near = np.full_like(lon, shape.radius + _CLEARANCE)
    spokes = len(lon)
    around = 2 * np.pi * np.arange(spokes) / spokes
    rings = [from_sphere(lon, lat, near, shape.center)]
    middle = np.radians(-2.0)
    rings.append(from_sphere(lon * 1.12, (lat - middle) * 1.45 + middle, near, shape.center))
    for polar, distance in ((100.0, 1.12), (150.0, 1.3)):
        sine, cosine = np.sin(np.radians(polar)), np.cos(np.radians(polar))
        direction = np.stack([sine * np.cos(around), sine * np.sin(around), np.full(spokes, cosine)], axis=1)
        rings.append(shape.center + shape.radius * distance * direction)
    return np.stack(rings)
