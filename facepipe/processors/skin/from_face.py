"""Skeleton and weights of another face, on another topology."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from facepipe.errors import FacepipeError, InputError
from facepipe.geometry.heat_weights import heat_weights, normalised
from facepipe.geometry.warp import Warp, fit_warp, nearest_rotations
from facepipe.parts import FaceParts, FloatArray, Skeleton
from facepipe.processors.skin.correspondence import main_places
from facepipe.processors.skin.eyeballs import Eyeball, eyeballs_of
from facepipe.processors.skin.matched_parts import matched_parts
from facepipe.processors.skin.report import TransferReport
from facepipe.processors.skin.skeletons import with_binds
from facepipe.processors.skin.skinning import Skinning
from facepipe.processors.skin.slits import slits_of
from facepipe.processors.skin.surface import Surface, surface_of
from facepipe.rig import build

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

    :param where: what messages call the source
    :param smoothing: mm
    :raises InputError: no joints or weights on the source, no landmarks on either
    """
    if not source.skeleton.joints or not any(mesh.skin for mesh in source.meshes):
        raise InputError(where, "no joints with skin weights, expected a skinned face")
    other = surface_of(source, where)
    for one in (surface, other):
        if one.landmarks is None:
            raise InputError(one.where, "no 68 landmarks of multipie68, expected them on both faces")
    weights, warnings = _weights(source, other)
    pairs = _paired(surface, other)
    warp = _warp(surface, other, pairs)
    warped = warp.apply(other.points)
    places = main_places(surface, slits_of(surface), other, slits_of(other), warped)
    found, origin = matched_parts(surface, other, warped, weights, pairs)
    lengths = np.clip(places.distances / _TRUSTED, _SHARP, _LONGEST) * max(smoothing, _SHARP)
    inside = surface.inside
    local = surface.part_triangles(inside, even=True)
    found[inside] = heat_weights(surface.points[inside], local, normalised(places.of(weights)), lengths)
    landmarks = np.linalg.norm(warped[other.landmarks] - surface.points[surface.landmarks], axis=1)
    report = TransferReport(
        source=where,
        landmarks_mm=float(landmarks.max()),
        surface_mm=_summary(places.distances),
        eyeballs=len(pairs),
        parts=origin,
    )
    warnings = (*warnings, *_shape_warnings(surface, other, warp))
    return Skinning(
        skeleton=_skeleton(parts, source, warp), weights=normalised(found), transfer=report, warnings=warnings
    )


def _summary(away: FloatArray) -> dict[str, float]:
    rms, p95 = np.sqrt((away**2).mean()), np.percentile(away, 95)
    return {"mean": float(away.mean()), "rms": float(rms), "p95": float(p95), "max": float(away.max())}


def _weights(source: FaceParts, surface: Surface) -> tuple[FloatArray, tuple[str, ...]]:
    """(m, j) of the sewn points, and warnings; points without, as of meshes without skin, go with the first root."""
    try:
        rig = build(source)
    except FacepipeError as error:
        raise error.under(surface.where) from None
    table = np.asarray(rig.influences.toarray())[np.unique(surface.group, return_index=True)[1]]
    weights, bare = np.maximum(table[:, :-1], 0.0), table[:, -1] > 0
    warnings = []
    negative, none = int((table < 0).any(axis=1).sum()), (weights.sum(axis=1) <= 0) & ~bare
    if negative:
        warnings.append(f"{surface.where}: {negative} points have weights below 0, which count as 0")
    if none.any():
        warnings.append(f"{surface.where}: {int(none.sum())} points have no weights, and go with the root")
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
    return with_binds(parts.skeleton, source.skeleton.joints, bind)
