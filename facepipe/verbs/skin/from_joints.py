"""Skeleton and weights from where joints are: the nearest along the surface, spread like heat, never across lips."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.core.names import suggestion
from facepipe.geometry.closest_points import closest_places
from facepipe.geometry.geodesics import graph_distances
from facepipe.geometry.heat_weights import heat_weights, normalised
from facepipe.geometry.polygons import components
from facepipe.parts import FaceParts, all_regions
from facepipe.verbs.skin.features import LOWER, UPPER, Slit, eyeballs_of, slits_of, smoothstep
from facepipe.verbs.skin.joints_file import JointSet, JointSpec
from facepipe.verbs.skin.loose_parts import following, hold, hold_parts, in_eyeballs, joints_in
from facepipe.verbs.skin.options import SkinOptions
from facepipe.verbs.skin.skinning import Skinning, skeleton_of
from facepipe.verbs.skin.surface import Surface, size_of

_REACH = 1.5  # a joint in the depth touches the points up to this many times as far as the nearest
_AS_NEAR = 1.1  # patches up to this many times as far as the nearest one are as near
_POWER = 12  # shares of the nearest joints fall with this power of their distances: ties are shared, no more
_BLUR = 0.15  # of a slit's width: band beside a corner over which joints and regions of a lip or lid fade out
_BESIDE = 0.5  # a joint is of a lip or lid up to this many widths of the slit from its rim
_RIVALS = 16  # joints, the nearest, that share a point
_FULL = 0.25  # of its radius: up to there a joint has its full weight
_LEAST = 1e-6  # mm: a radius below counts as this
_FARTHEST = 20.0  # sizes of the face that a joint may be away from it
_AROUND = 0.5  # sizes of the face that joints usually lie around its box at most
_TOGETHER = 0.05  # of the face's size: joints nearer to each other lie in a heap
_HEAP = 3  # joints, from which on that is a sign


def from_joints(parts: FaceParts, surface: Surface, joints: JointSet, options: SkinOptions) -> Skinning:
    """Skeleton and weights from joint positions."""
    scale = joints.scale(parts.meters_per_unit)
    positions = np.array([joint.position for joint in joints.joints]) * scale
    millimetres = positions * parts.meters_per_unit * 1000.0
    _check_near(surface, joints, millimetres)
    slits = slits_of(surface)
    eyeballs = eyeballs_of(surface)
    apart = [joint.surface is True or bool(joint.regions) for joint in joints.joints]  # of the face for sure
    turned = joints_in(eyeballs, millimetres, np.array(apart))
    held = in_eyeballs(eyeballs, millimetres)
    moves = np.array([_moves(joint, one) for joint, one in zip(joints.joints, held, strict=True)])
    if not moves.any():
        raise InputError(joints.where, "no joint moves the face itself, expected one outside eyeballs, or `surface`")
    chosen = [joint for joint, one in zip(joints.joints, moves, strict=True) if one]
    to_mm = scale * parts.meters_per_unit * 1000.0
    radii = np.array([np.inf if joint.radius is None else max(joint.radius * to_mm, _LEAST) for joint in chosen])
    masks = [_mask(parts, surface, slits, joint, joints.where) for joint in chosen]
    own = _joint_weights(surface, chosen, millimetres[moves], radii, masks, slits, options.sharpness)
    weights = np.zeros((len(surface.points), len(moves)))
    weights[:, moves] = following(surface, own)
    # after `following`, by which eyeballs would stick to the lids around them
    for number, joint in turned.items():
        hold(weights, eyeballs[number].points, joint)
    paths = tuple(joint.path for joint in joints.joints)
    mouth = next((slit for slit in slits if slit.name == "mouth"), None)
    hold_parts(surface, weights, joints.parts, paths, mouth)
    rotations = np.array([joint.rotation for joint in joints.joints])
    warning = "no multipie68 landmarks: joints beside lips and lids may move the other one round the corner"
    warnings = (*_joint_warnings(surface, joints, millimetres), *(() if slits else (warning,)))
    return Skinning(
        skeleton=skeleton_of(parts.skeleton, paths, positions, rotations),
        weights=weights,
        warnings=warnings,
    )


def _moves(joint: JointSpec, in_eyeball: bool) -> bool:
    return joint.surface if joint.surface is not None else bool(joint.regions) or not in_eyeball


def _mask(
    parts: FaceParts, surface: Surface, slits: tuple[Slit, ...], joint: JointSpec, where: str
) -> FloatArray | None:
    """(m,) how much of each point the regions of a joint hold."""
    if not joint.regions:
        return None
    first = np.unique(surface.group, return_index=True)[1]
    known: dict[str, FloatArray] = {
        name: np.asarray(mask, np.float64)[first] for name, mask in all_regions(parts.meshes).items()
    }
    for slit in slits:
        for side, sign in (("upper", UPPER), ("lower", LOWER)):
            known.setdefault(f"{slit.name}_{side}", slit.share(sign, _BLUR))
    for name in joint.regions:
        if name not in known:
            near = suggestion(name, known, "none: the face has neither regions nor landmarks")
            raise InputError(f"{where} -> {joint.path} -> regions", f"no '{name[:60]}'{near}")
    return np.asarray(np.clip(np.sum([known[name] for name in joint.regions], axis=0), 0.0, 1.0))


def _joint_weights(
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
    # heat takes weights in with 1 / distance^2: infinite at a point that a joint lies on
    floor = 1e-3 * float(np.median(nearest)) + 1e-9
    shares = _shares(np.maximum(distances, floor), allowed)
    local = surface.part_triangles(inside, even=True)
    spread = normalised(heat_weights(surface.points[inside], local, shares, np.maximum(nearest, floor), sharpness))
    # heat also runs to where a joint may not be: that goes back to the shares, which keep to what is allowed
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
    near_shares = may.copy()
    for rival in range(width):
        with np.errstate(over="ignore", invalid="ignore"):
            nearer = 1.0 / (1.0 + (near[:, rival, None] / near) ** _POWER)  # how much the rival comes first
        nearer[:, rival] = 0.0
        near_shares *= 1.0 - may[:, rival, None] * np.where(np.isfinite(nearer), nearer, 0.0)
    near_shares = normalised(near_shares)
    if chosen is None:
        return near_shares
    shares = np.zeros_like(distances)
    np.put_along_axis(shares, chosen, near_shares, axis=1)
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


def _check_near(surface: Surface, joints: JointSet, positions: FloatArray) -> None:
    """:raises InputError: a joint (of positions (j, 3), mm) that is nowhere near the face"""
    points = surface.points[surface.inside]
    middle, size = points.mean(axis=0), size_of(points)
    for joint, position in zip(joints.joints, positions, strict=True):
        away = float(np.linalg.norm(position - middle))
        if away > _FARTHEST * size:
            what = f"{away:.4g} mm from the face, expected at most {_FARTHEST * size:.4g} (positions are in the unit"
            raise InputError(f"{joints.where} -> {joint.path[:80]}", f"{what} '{joints.unit}')")


def _joint_warnings(surface: Surface, joints: JointSet, positions: FloatArray) -> tuple[str, ...]:
    """Most joints (of positions (j, 3), mm) outside the face, or all in a heap."""
    points = surface.points[surface.inside]
    size, count = size_of(points), len(positions)
    unit = f"mm (positions are in the unit '{joints.unit}')"
    off = np.maximum(points.min(axis=0) - positions, positions - points.max(axis=0)).clip(0.0)
    away = np.linalg.norm(off, axis=1)
    outside = int((away > _AROUND * size).sum())
    if 2 * outside > count:
        return (f"{joints.where}: {outside} of {count} joints lie outside the face, up to {away.max():.4g} {unit}",)
    spread = size_of(positions)
    if count >= _HEAP and spread < _TOGETHER * size:
        return (f"{joints.where}: all {count} joints lie within {spread:.4g} {unit}, the face in {size:.4g} mm",)
    return ()
