"""How lids move: along the eyeball, by latitude and longitude."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from procedural_head import eyes, topology
from procedural_head.eyes import Eye, from_sphere, to_sphere

_FOLLOW = np.array([0.0, 0.06, 0.22, 0.5, 0.78, 0.94, 1.0, 1.0, 0.85, 0.4, 0.0])  # share of the rim's motion, by ring
MEETING = 0.2  # where closed lids meet, from the lower rim (0) to the upper (1)
_CLOSED_GAP = 0.003  # radians left between the closed rims


@dataclass(frozen=True)
class LidMotion:
    """Motion of the left eye's rims in radians, by spoke (2 half,)."""

    latitude: FloatArray
    longitude: FloatArray


def motion(shape: Eye, *, upper: float = 0.0, lower: float = 0.0, turn: float = 0.0, close: float = 0.0) -> LidMotion:
    """Raise the rims by `upper` and `lower` degrees in the middle, `turn` them outwards, `close` a share of the gap."""
    spokes = topology.build().rings["eyeLeft"].shape[1]
    half = spokes // 2
    _, rim = eyes.rim_angles(shape, spokes)
    index = np.arange(spokes)
    is_upper = index <= half
    pair = (spokes - index) % spokes
    across = np.where(is_upper, index, spokes - index) / half
    middle = np.sin(np.pi * across) ** 0.7
    latitude = np.radians(np.where(is_upper, upper, lower)) * middle
    high, low = np.where(is_upper, rim, rim[pair]), np.where(is_upper, rim[pair], rim)
    meeting = low + MEETING * (high - low)
    gap = np.minimum(_CLOSED_GAP, high - low) * np.where(is_upper, 0.5, -0.5)
    latitude += close * np.where(high > low, meeting + gap - rim, 0.0)
    return LidMotion(latitude, np.radians(turn) * middle)


def head_offsets(points: FloatArray, shape: Eye, move: LidMotion, share: float = 1.0) -> FloatArray:
    """(n, 3) offsets of the head's points for a share of a left lid motion."""
    rings = topology.build().rings["eyeLeft"]
    offsets = np.zeros_like(points)
    here = points[rings]
    longitude, latitude, distance = to_sphere(here, shape.center)
    follow = _FOLLOW[:, None] * share
    moved = from_sphere(longitude + follow * move.longitude, latitude + follow * move.latitude, distance, shape.center)
    offsets[rings] = moved - here
    return offsets


def lash_offsets(points: FloatArray, spoke: IntArray, shape: Eye, move: LidMotion, share: float = 1.0) -> FloatArray:
    """(k, 3) offsets of the left lashes, which turn with their spoke of the rim."""
    longitude, latitude, distance = to_sphere(points, shape.center)
    moved = from_sphere(
        longitude + share * move.longitude[spoke], latitude + share * move.latitude[spoke], distance, shape.center
    )
    return np.asarray(moved - points)
