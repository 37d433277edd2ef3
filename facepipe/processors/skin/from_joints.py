"""Weights from where joints are: what is nearest along the surface, spread like heat, never across lips or lids."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.geometry.closest_points import closest_places
from facepipe.geometry.geodesics import graph_distances
from facepipe.geometry.heat_weights import heat_weights, normalised
from facepipe.geometry.polygons import components
from facepipe.processors.skin.joints_file import JointSpec
from facepipe.processors.skin.slits import LOWER, UPPER, Slit, smoothstep
from facepipe.processors.skin.surface import Surface

_REACH = 1.5  # a joint in the depth touches the points up to so many times as far as the nearest
_AS_NEAR = 1.1  # patches up to so many times as far as the nearest one are as near
_POWER = 12  # shares of the nearest joints fall with this power of their distances: ties are shared, no more
_BLUR = 0.15  # of a slit's width: band beside a corner over which a lip or lid joint fades out
_BESIDE = 0.5  # a joint is of a lip or lid up to so many widths of the slit from its rim
_RIVALS = 16  # joints, the nearest, that share a point
_FULL = 0.25  # of its radius: up to there a joint has its full weight


def joint_weights(
    surface: Surface,
    joints: Sequence[JointSpec],
    positions: FloatArray,
    radii: FloatArray,
    masks: Sequence[FloatArray | None],
    slits: Sequence[Slit],
    sharpness: float,
) -> FloatArray:
    """(i, j) weights of the joints on the i points of the main component, in sum 1.

    :param positions: (j, 3) mm
    :param radii: (j,) mm, infinite without
    :param masks: (m,) of each joint, how much of every point it may have
    :raises InputError: a point that no joint may move
    """
    inside = surface.inside
    distances = _distances(surface, positions)[:, inside].T
    allowed = np.stack([np.ones(len(inside)) if mask is None else mask[inside] for mask in masks], axis=1)
    reached = np.isfinite(distances)
    allowed *= smoothstep((1.0 - np.where(reached, distances, 0.0) / radii) / (1.0 - _FULL)) * reached
    allowed *= _sides(surface, positions, slits)[inside]
    stranded = int((allowed.max(axis=1) <= 0).sum())
    if stranded:
        what = f"{stranded} points of {len(inside)} that no joint may move"
        raise InputError(surface.where, f"{what}, expected a joint without radius, regions or beside a lip")
    nearest = np.where(allowed > 0, distances, np.inf).min(axis=1)
    floor = 1e-3 * float(np.median(nearest)) + 1e-9
    shares = _shares(np.maximum(distances, floor), allowed)
    local = surface.part_triangles(inside, even=True)
    spread = normalised(heat_weights(surface.points[inside], local, shares, np.maximum(nearest, floor), sharpness))
    kept = spread * allowed
    return np.asarray(kept + (1.0 - kept.sum(axis=1, keepdims=True)) * shares)


def _shares(distances: FloatArray, allowed: FloatArray) -> FloatArray:
    """(i, j) what of each point is whose: all of it the nearest joint's, as far as that may have it, then the next's.

    Joints about as near as each other share alike, so that no order among them counts.
    """
    width = min(_RIVALS, distances.shape[1])
    away = np.where(allowed > 0, distances, np.inf)
    chosen = np.argpartition(away, width - 1, axis=1)[:, :width] if width < away.shape[1] else None
    pick = (lambda table: table) if chosen is None else (lambda table: np.take_along_axis(table, chosen, axis=1))
    near, may = pick(away), pick(allowed)
    found = may.copy()
    for rival in range(width):
        with np.errstate(over="ignore", invalid="ignore"):
            nearer = 1.0 / (1.0 + (near[:, rival, None] / near) ** _POWER)  # how much the rival comes first
        nearer[:, rival] = 0.0
        found *= 1.0 - may[:, rival, None] * np.where(np.isfinite(nearer), nearer, 0.0)
    found = normalised(found)
    if chosen is None:
        return found
    shares = np.zeros_like(distances)
    np.put_along_axis(shares, chosen, found, axis=1)
    return shares


def _distances(surface: Surface, positions: FloatArray) -> FloatArray:
    """(j, m) from the joints, in a straight line to the surface near them and along it from there."""
    local = surface.part_triangles(surface.inside)
    places = closest_places(positions, surface.points[surface.inside], local)
    sources, starts = [], []
    for position, depth, triangle in zip(positions, places.distances, places.triangles, strict=True):
        corners = surface.inside[local[triangle]]
        touched = _touched(surface, position, _REACH * depth, corners)
        sources.append(touched)
        starts.append(np.linalg.norm(surface.points[touched] - position, axis=1))
    return graph_distances(surface.graph, sources, starts)


def _touched(surface: Surface, position: FloatArray, reach: float, corners: IntArray) -> IntArray:
    """Points within `reach`, in patches of the surface that are about as near as that of the nearest triangle.

    A joint of the lower lip has the upper one within its reach, but not through the lip; one in the middle of the head
    has a nearest place on either side.
    """
    away = np.linalg.norm(surface.points - position, axis=1)
    near = (away <= reach) & (surface.component == surface.main)
    near[corners] = True
    numbers = np.flatnonzero(near)
    place = np.full(len(near), -1)
    place[numbers] = np.arange(len(numbers))
    pairs = place[surface.edges]
    patch = components(len(numbers), pairs[(pairs >= 0).all(axis=1)])
    nearest = np.full(int(patch.max()) + 1, np.inf)
    np.minimum.at(nearest, patch, away[numbers])
    chosen = nearest <= _AS_NEAR * nearest.min()
    chosen[patch[place[corners]]] = True
    return np.asarray(numbers[chosen[patch]])


def _sides(surface: Surface, positions: FloatArray, slits: Sequence[Slit]) -> FloatArray:
    """(m, j) 0 for a joint of one lip or lid on the other, 1 elsewhere, smooth beside the corners."""
    shares = np.ones((len(surface.points), len(positions)))
    local = surface.part_triangles(surface.inside)
    places = closest_places(positions, surface.points[surface.inside], local)
    for slit in slits:
        corners = surface.inside[local[places.triangles]]
        side, distance = slit.side[corners].mean(axis=1), slit.distance[corners].min(axis=1) + places.distances
        beside = distance <= _BESIDE * slit.width
        for sign in (UPPER, LOWER):
            of_one = beside & (sign * side > _BLUR)
            shares[:, of_one] *= slit.share(sign, _BLUR)[:, None]
    return shares
