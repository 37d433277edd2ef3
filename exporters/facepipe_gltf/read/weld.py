"""Vertices back to points: which vertices are one point that was split at a UV or normal seam."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.polygons import distinct_rows
from facepipe_gltf.read.primitives import Geometry, Target, Vertices


@dataclass(frozen=True)
class Weld:
    """The point of every vertex (n,), -1 for vertices left out, and a vertex of every point (p,)."""

    points: IntArray
    vertices: IntArray

    @cached_property
    def first(self) -> IntArray:
        """(n,) the point of every vertex that stands for one, else -1."""
        first = np.full(len(self.points), -1, np.int64)
        first[self.vertices] = np.arange(len(self.vertices))
        return first

    @cached_property
    def counts(self) -> IntArray:
        """(p,) vertices of every point."""
        return np.bincount(self.points[self.points >= 0], minlength=len(self.vertices))


def none(vertices: Vertices) -> Weld:
    """Every vertex its own point."""
    own = np.arange(len(vertices.positions))
    return Weld(own, own)


def by_number(geometry: Geometry, numbers: IntArray) -> Weld | None:
    """Points in the order of `numbers` (n,), gaps closed; None where vertices of one number lie apart."""
    used = _used(geometry)
    _, first, inverse = np.unique(numbers[used], return_index=True, return_inverse=True)
    positions = geometry.vertices.positions[used]
    if np.any(positions != positions[first][inverse]):
        return None
    return _placed(len(geometry.vertices.positions), used, first, inverse)


def by_value(geometry: Geometry) -> Weld:
    """One point for vertices equal in position, skin weights and morph deltas, in order of first appearance.

    Vertices that no triangle uses are left out.
    """
    used = _used(geometry)
    vertices = geometry.vertices
    columns = [_bits(vertices.positions[used])]
    if vertices.joints is not None and vertices.weights is not None:
        columns += [vertices.joints[used].astype(np.uint32), _bits(vertices.weights[used])]
    first, inverse = distinct_rows(np.concatenate(columns, axis=1))
    weld = _placed(len(geometry.vertices.positions), used, first, inverse)
    scratch = np.zeros_like(vertices.positions)
    for target in vertices.targets:
        weld = _refine(weld, target, scratch)
    return weld


def _used(geometry: Geometry) -> IntArray:
    mask = np.zeros(len(geometry.vertices.positions), bool)
    mask[geometry.triangles.ravel()] = True
    return np.flatnonzero(mask)


def _placed(count: int, used: IntArray, first: IntArray, inverse: IntArray) -> Weld:
    points = np.full(count, -1, np.int64)
    points[used] = inverse
    return Weld(points, used[first])


def _refine(weld: Weld, target: Target, scratch: FloatArray) -> Weld:
    """Split points whose vertices move apart in `target`; `scratch` (n, 3) is zero before and after."""
    shared = np.flatnonzero((weld.points >= 0) & (weld.first < 0))
    if not len(shared) or not len(target.positions.indices):
        return weld
    scratch[target.positions.indices] = target.positions.values
    apart = np.any(scratch[shared] != scratch[weld.vertices[weld.points[shared]]], axis=1)
    refined = weld
    if apart.any():
        used = np.flatnonzero(weld.points >= 0)
        rows = np.concatenate([weld.points[used, None].astype(np.uint32), _bits(scratch[used])], axis=1)
        first, inverse = distinct_rows(rows)
        refined = _placed(len(weld.points), used, first, inverse)
    scratch[target.positions.indices] = 0.0
    return refined


def _bits(values: FloatArray) -> IntArray:
    """float32 values as integers that are equal where the values are (-0 is 0)."""
    return np.ascontiguousarray(values + np.float32(0.0), np.float32).view(np.uint32)
