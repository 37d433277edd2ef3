"""Skeleton and weights of another face, on another topology."""

from __future__ import annotations

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
    weights = _weights(source, other)
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
    away = places.distances
    report = TransferReport(
        source=where,
        landmarks_mm=float(landmarks.max()),
        surface_mm={
            "mean": float(away.mean()),
            "rms": float(np.sqrt((away**2).mean())),
            "p95": float(np.percentile(away, 95)),
            "max": float(away.max()),
        },
        eyeballs=len(pairs),
        parts=origin,
    )
    return Skinning(skeleton=_skeleton(parts, source, warp), weights=normalised(found), transfer=report)


def _weights(source: FaceParts, surface: Surface) -> FloatArray:
    """(m, j) of the sewn points; points of meshes without skin go with the first root."""
    rig = build(source)
    table = np.asarray(rig.influences.toarray())[np.unique(surface.group, return_index=True)[1]]
    weights = table[:, :-1]
    weights[:, int(np.flatnonzero(rig.parents < 0)[0])] += table[:, -1]
    return normalised(weights)


def _paired(target: Surface, source: Surface) -> list[tuple[Eyeball, Eyeball]]:
    """Eyeballs of both faces by the eye that their landmarks draw around them."""
    pairs = []
    for eye in (slice(36, 42), slice(42, 48)):
        own, other = (_of_eye(one, eye) for one in (target, source))
        if own is not None and other is not None:
            pairs.append((own, other))
    return pairs


def _of_eye(surface: Surface, eye: slice) -> Eyeball | None:
    assert surface.landmarks is not None
    lids = surface.points[surface.landmarks[eye]]
    width = float(np.linalg.norm(lids[0] - lids[3]))
    near = [(float(np.linalg.norm(ball.centre - lids.mean(axis=0))), i) for i, ball in enumerate(eyeballs_of(surface))]
    near = [one for one in near if one[0] <= width]
    return eyeballs_of(surface)[min(near)[1]] if near else None


def _warp(target: Surface, source: Surface, pairs: list[tuple[Eyeball, Eyeball]]) -> Warp:
    assert target.landmarks is not None
    assert source.landmarks is not None
    to = [target.points[target.landmarks], *(own.centre[None] for own, _ in pairs)]
    start = [source.points[source.landmarks], *(other.centre[None] for _, other in pairs)]
    try:
        return fit_warp(np.concatenate(start), np.concatenate(to), _MISSED)
    except FacepipeError as error:
        raise error.under(source.where) from None


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
