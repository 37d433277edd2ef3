"""Skeleton and weights of another face, on another topology."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import FacepipeError, InputError, TopologyError
from facepipe.geometry.heat_weights import heat_weights, normalised
from facepipe.geometry.warp import Warp, fit_warp, nearest_rotations
from facepipe.parts import FaceParts, Skeleton
from facepipe.rig import build
from facepipe.verbs.same_topology import in_order
from facepipe.verbs.skin.correspondence import main_places, matched_parts
from facepipe.verbs.skin.features import Eyeball, eyeballs_of, slits_of
from facepipe.verbs.skin.skinning import Skinning, TransferReport, with_binds
from facepipe.verbs.skin.surface import Surface, surface_of

_MISSED = 0.5  # mm: landmarks are set by hand, and missed by about as much where that saves bending
_SHARP = 1e-3  # mm: weights of points that lie on the other face are smoothed no more than this
_TRUSTED = 1.0  # mm: from there on weights are smoothed over the whole length, and more as places are farther off
_LONGEST = 4.0  # times the length
_STRANGE, _UNLIKE = (
    0.3,
    0.5,
)  # of landmarks' spread: heads lie 0.08 to 0.2 apart, mirrored ones 0.7


def from_face(parts: FaceParts, surface: Surface, source: FaceParts, where: str, smoothing: float) -> Skinning:
    """Skeleton and weights of `source`, on the surface of `parts`.

    On one topology points take the weights of their own; on others, those of places that the warp lays on them.

    :param where: what messages call the source
    :param smoothing: mm
    :raises InputError: no joints or weights on the source, no landmarks on either
    """
    if not source.skeleton.joints or not any(mesh.skin for mesh in source.meshes):
        raise InputError(where, "no joints with skin weights, expected a skinned face")
    twin = _twin(parts, source)
    other = surface_of(source if twin is None else twin, where)
    for one in (surface, other):
        if one.landmarks is None:
            raise InputError(one.where, "no 68 landmarks of multipie68, expected them on both faces")
    pairs = _paired(surface, other)
    warp = _warp(surface, other, pairs)
    if twin is None:
        weights, warnings = _weights(source, other.group, where)
        result, origin, away = _by_place(surface, other, warp, weights, pairs, smoothing)
    else:
        # by number, without a search: after the warp the nearest place need not be a point's own
        result, warnings = _weights(twin, surface.group, where)
        origin = {name: (name,) for name in sorted(surface.mesh_names)}
        away = np.linalg.norm(warp.apply(_points_of(other, surface)) - surface.points, axis=1)[surface.inside]
    landmarks = np.linalg.norm(warp.apply(other.points[other.landmarks]) - surface.points[surface.landmarks], axis=1)
    report = TransferReport(
        source=where,
        same_topology=twin is not None,
        landmarks_mm=float(landmarks.max()),
        surface_mm=_summary(away),
        eyeballs=len(pairs),
        parts=origin,
    )
    warnings = (*warnings, *_shape_warnings(surface, other, warp))
    return Skinning(
        skeleton=_skeleton(parts, source, warp), weights=normalised(result), transfer=report, warnings=warnings
    )


def _twin(parts: FaceParts, source: FaceParts) -> FaceParts | None:
    """The source with the meshes of the face, where it is on one topology with it."""
    try:
        return in_order(parts, parts.name, source, source.name)
    except TopologyError:
        return None


def _points_of(other: Surface, surface: Surface) -> FloatArray:
    """(m, 3) the points of the other face that are those of this one, on one topology."""
    return other.points[other.group[np.unique(surface.group, return_index=True)[1]]]


def _by_place(
    surface: Surface,
    other: Surface,
    warp: Warp,
    weights: FloatArray,
    pairs: list[tuple[Eyeball, Eyeball]],
    smoothing: float,
) -> tuple[FloatArray, Mapping[str, tuple[str, ...]], FloatArray]:
    """Weights (m, j), which meshes gave them to which, and how far the main part is from the other's (i,) mm."""
    warped = warp.apply(other.points)
    places = main_places(surface, slits_of(surface), other, slits_of(other), warped)
    result, origin = matched_parts(surface, other, warped, weights, pairs)
    lengths = np.clip(places.distances / _TRUSTED, _SHARP, _LONGEST) * max(smoothing, _SHARP)
    inside = surface.inside
    local = surface.part_triangles(inside, even=True)
    result[inside] = heat_weights(surface.points[inside], local, normalised(places.interpolated(weights)), lengths)
    return result, origin, places.distances


def _summary(away: FloatArray) -> dict[str, float]:
    rms, p95 = np.sqrt((away**2).mean()), np.percentile(away, 95)
    return {"mean": float(away.mean()), "rms": float(rms), "p95": float(p95), "max": float(away.max())}


def _weights(source: FaceParts, group: IntArray, where: str) -> tuple[FloatArray, tuple[str, ...]]:
    """(m, j) of points sewn by `group` (n,), and warnings; those without, as in meshes without skin: the first root."""
    try:
        rig = build(source)
    except FacepipeError as error:
        raise error.under(where) from None
    table = np.asarray(rig.influences.toarray())[np.unique(group, return_index=True)[1]]
    weights, bare = np.maximum(table[:, :-1], 0.0), table[:, -1] > 0
    warnings = []
    negative, none = int((table < 0).any(axis=1).sum()), (weights.sum(axis=1) <= 0) & ~bare
    if negative:
        warnings.append(f"{where}: {negative} points have weights below 0, which count as 0")
    if none.any():
        warnings.append(f"{where}: {int(none.sum())} points have no weights, and go with the root")
    weights[none | bare, int(np.flatnonzero(rig.parents < 0)[0])] = 1.0
    return normalised(weights), tuple(warnings)


def _paired(target: Surface, source: Surface) -> list[tuple[Eyeball, Eyeball]]:
    """Eyeballs of both faces by the eye that their landmarks draw around them."""
    pairs = []
    balls = [eyeballs_of(one) for one in (target, source)]
    for eye in (slice(36, 42), slice(42, 48)):
        own, other = (_of_eye(one, found, eye) for one, found in zip((target, source), balls, strict=True))
        if own is not None and other is not None:
            pairs.append((own, other))
    return pairs


def _of_eye(surface: Surface, balls: Sequence[Eyeball], eye: slice) -> Eyeball | None:
    assert surface.landmarks is not None
    lids = surface.points[surface.landmarks[eye]]
    width = float(np.linalg.norm(lids[0] - lids[3]))
    near = [(float(np.linalg.norm(ball.centre - lids.mean(axis=0))), i) for i, ball in enumerate(balls)]
    near = [one for one in near if one[0] <= width]
    return balls[min(near)[1]] if near else None


def _warp(target: Surface, source: Surface, pairs: list[tuple[Eyeball, Eyeball]]) -> Warp:
    assert target.landmarks is not None
    assert source.landmarks is not None
    for one in (target, source):
        if not np.ptp(one.points[one.landmarks], axis=0).any():
            raise InputError(one.where, "all landmarks at one place, expected 68 of multipie68")
    to = [target.points[target.landmarks], *(own.centre[None] for own, _ in pairs)]
    start = [source.points[source.landmarks], *(other.centre[None] for _, other in pairs)]
    try:
        warp = fit_warp(np.concatenate(start), np.concatenate(to), _MISSED)
    except FacepipeError as error:
        raise error.under(source.where) from None
    if (unlike := _unlikeness(target, source, warp)) > _UNLIKE:
        what = f"landmarks lie {unlike:.0%} of their spread from those of {source.where}, scaled and turned onto them"
        raise InputError(target.where, f"{what}: expected multipie68 on both, from the face's right to its left")
    return warp


def _unlikeness(target: Surface, source: Surface, warp: Warp) -> float:
    """RMS distance of the landmarks, scaled and turned onto one another, over their RMS distance from the middle."""
    assert target.landmarks is not None
    assert source.landmarks is not None
    own = target.points[target.landmarks]
    away = warp.similarity.apply(source.points[source.landmarks]) - own
    return float(np.sqrt((away**2).sum() / ((own - own.mean(axis=0)) ** 2).sum()))


def _shape_warnings(target: Surface, source: Surface, warp: Warp) -> tuple[str, ...]:
    unlike = _unlikeness(target, source, warp)
    if unlike <= _STRANGE:
        return ()
    what = f"landmarks lie {unlike:.0%} of their spread from those of {source.where}, scaled and turned onto them"
    return (f"{what}: look at the weights",)


def _skeleton(parts: FaceParts, source: FaceParts, warp: Warp) -> Skeleton:
    """The source's joints warped: places as the warp moves them, axes turned by the rotation nearest to it there."""
    to_world = np.asarray(source.skeleton.transform, np.float64)
    worlds = to_world @ np.asarray(source.skeleton.bind_transforms, np.float64)
    places = worlds[:, :3, 3] * source.meters_per_unit * 1000.0
    bind = np.tile(np.eye(4), (len(worlds), 1, 1))
    bind[:, :3, :3] = nearest_rotations(warp.jacobians(places)) @ nearest_rotations(worlds[:, :3, :3])
    bind[:, :3, 3] = warp.apply(places) / (parts.meters_per_unit * 1000.0)
    to_skeleton = np.linalg.inv(np.asarray(parts.skeleton.transform, np.float64))
    bind = to_skeleton @ bind
    bind[:, :3, :3] = nearest_rotations(bind[:, :3, :3])
    made = with_binds(parts.skeleton, source.skeleton.joints, bind)
    return replace(made, joint_names=source.skeleton.joint_names)
