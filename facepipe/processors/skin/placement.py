"""Signs that lengths are in another unit than is said: warnings, since a face may be of any size."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.processors.skin.joints_file import JointSet
from facepipe.processors.skin.surface import Surface

_FARTHEST = 20.0  # sizes of the face that a joint may be away from it
_AROUND = 0.5  # sizes of the face that joints usually lie around its box at most
_TOGETHER = 0.05  # of the face's size: joints nearer to each other lie in a heap
_HEAP = 3  # joints, from which on that is a sign
_EYES = (30.0, 300.0)  # mm from the outer corner of one eye to that of the other
_ACROSS = (20.0, 10000.0)  # mm, of a face without landmarks
_CORNERS = (36, 45)  # of multipie68


def check_near(surface: Surface, joints: JointSet, positions: FloatArray) -> None:
    """:raises InputError: a joint (of positions (j, 3), mm) that is nowhere near the face"""
    points = surface.points[surface.inside]
    middle, size = points.mean(axis=0), _size(points)
    for joint, position in zip(joints.joints, positions, strict=True):
        away = float(np.linalg.norm(position - middle))
        if away > _FARTHEST * size:
            what = f"{away:.4g} mm from the face, expected at most {_FARTHEST * size:.4g} (positions are in the unit"
            raise InputError(f"{joints.where} -> {joint.path[:80]}", f"{what} '{joints.unit}')")


def joint_warnings(surface: Surface, joints: JointSet, positions: FloatArray) -> tuple[str, ...]:
    """Most joints (of positions (j, 3), mm) outside the face, or all in a heap."""
    points = surface.points[surface.inside]
    size, count = _size(points), len(positions)
    unit = f"mm (positions are in the unit '{joints.unit}')"
    off = np.maximum(points.min(axis=0) - positions, positions - points.max(axis=0)).clip(0.0)
    away = np.linalg.norm(off, axis=1)
    outside = int((away > _AROUND * size).sum())
    if 2 * outside > count:
        return (f"{joints.where}: {outside} of {count} joints lie outside the face, up to {away.max():.4g} {unit}",)
    spread = _size(positions)
    if count >= _HEAP and spread < _TOGETHER * size:
        return (f"{joints.where}: all {count} joints lie within {spread:.4g} {unit}, the face in {size:.4g} mm",)
    return ()


def size_warnings(surface: Surface) -> tuple[str, ...]:
    """A face whose size hints at the wrong metersPerUnit; lengths such as the radius of an eyeball count on it."""
    if surface.landmarks is None:
        across, (low, high), what = _size(surface.points[surface.inside]), _ACROSS, "across"
    else:
        across = float(np.linalg.norm(np.subtract(*surface.points[surface.landmarks[list(_CORNERS)]])))
        (low, high), what = _EYES, "from eye to eye"
    if low <= across <= high:
        return ()
    return (f"the face is {across:.4g} mm {what}, expected {low:g} to {high:g}: its metersPerUnit may be wrong",)


def _size(points: FloatArray) -> float:
    return float(np.linalg.norm(np.ptp(points, axis=0)))
