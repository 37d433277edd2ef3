"""Skeleton and weights of another face, on another topology, by where its points lie: lips on lips, lids on lids."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import FacepipeError, InputError, TopologyError
from facepipe.geometry.closest_points import closest_places, place_shares
from facepipe.geometry.heat_weights import heat_weights, normalised
from facepipe.geometry.polygons import point_normals
from facepipe.geometry.warp import Warp, fit_warp, nearest_rotations
from facepipe.parts import FaceParts
from facepipe.rig import build
from facepipe.verbs.skin.skinning import Skinning, TransferReport, with_binds
from facepipe.verbs.skin.surface import LOWER, UPPER, Eyeball, Slit, Surface, eyeballs_of, slits_of, surface_of
from facepipe.verbs.whole_faces import in_order

_SIDE = 0.1  # of a slit's width from the line beside its corners: from there a point is on one side
_BESIDE = 1.0  # points up to this many widths from a rim look on their own side only
_FACING = 0.0  # cosine between normals from which places match
_TRIED = 48  # points looked at for one that faces the same way
_TURNED = 3.0  # a place that faces the same way may be this many times as far
_SMALL = 30.0  # mm: parts up to this size, such as a tooth, are rather rigid
_RIGID = 0.95  # of all weights on one joint: a part of the source is rigid
_PREFERRED = 2.5  # they take a rigid part up to this many times as far as the nearest of all; others that alone
_NEAR = 10.0  # mm: and no farther than this
_LOOSE = 0.6  # distances from loose parts count so much where others choose: these touch the mouth around them
_BLEND = 3.0  # mm over which weights of parts blend
_TRUSTED = 0.5  # mm: weights of points nearer to the source than this blend less
_SHARP = 1e-3  # of the length: those of points that lie on it, not at all
_MISSED = 0.5  # mm: landmarks are set by hand, and missed by about as much where that saves bending
_SURE = 1.0  # mm: from there on weights are smoothed over the whole length, and more as places are farther off
_LONGEST = 4.0  # times the length
_STRANGE, _UNLIKE = (
    0.3,
    0.5,
)  # of landmarks' spread: heads lie 0.08 to 0.2 apart, mirrored ones 0.7


@dataclass(frozen=True, kw_only=True)
class Places:
    """For each of k points a place on the other face."""

    corners: IntArray  # (k, 3) sewn points of the other face
    shares: FloatArray  # (k, 3) in sum 1
    distances: FloatArray  # (k,) mm

    def interpolated(self, values: FloatArray) -> FloatArray:
        """(k, c) what of the values (m, c) at the other face's points is at the places."""
        return np.asarray(np.einsum("kc,kcj->kj", self.shares, values[self.corners]))


def nearest(points: FloatArray, warped: FloatArray, triangles: IntArray) -> Places:
    """The nearest places on the triangles."""
    places = closest_places(points, warped, triangles)
    shares = place_shares(places, warped, triangles)
    return Places(corners=triangles[places.triangles], shares=shares, distances=places.distances)


def _sides(
    target_slits: Sequence[Slit], source_slits: Sequence[Slit], points: IntArray, triangles: IntArray
) -> list[tuple[IntArray, IntArray]]:
    """Places in `points`, and the triangles that these may be on: all points once."""
    everywhere = np.arange(len(triangles))
    free = np.ones(len(points), bool)
    sides = []
    for slit, other in zip(target_slits, source_slits, strict=True):
        beside = slit.distance[points] <= _BESIDE * slit.width
        for sign in (UPPER, LOWER):
            chosen = free & beside & (sign * slit.side[points] > _SIDE)
            wrong = (sign * other.side[triangles] < -_SIDE).any(axis=1)
            if chosen.any() and not wrong.all():
                sides.append((np.flatnonzero(chosen), everywhere[~wrong]))
                free &= ~chosen
    return [*sides, (np.flatnonzero(free), everywhere)]


def _turned(
    part: Places, target: Surface, points: IntArray, warped: FloatArray, normals: FloatArray, allowed: IntArray
) -> Places:
    """The places, but of points that face away from theirs a near point that faces as they do, where there is one."""
    from scipy.spatial import cKDTree

    ours = target.normals[points]
    theirs = part.interpolated(normals)
    rows = np.flatnonzero((ours * theirs).sum(axis=1) <= _FACING)
    if not len(rows):
        return part
    count = min(_TRIED, len(allowed))
    away, near = cKDTree(warped[allowed]).query(target.points[points[rows]], k=np.arange(1, count + 1))
    facing = np.einsum("kni,ki->kn", normals[allowed[near]], ours[rows]) > _FACING
    first = facing.argmax(axis=1)
    at = np.arange(len(rows))
    # a multiple of nearly 0 would allow nothing at points that lie on the source: of 1 mm at least
    better = facing[at, first] & (away[at, first] <= _TURNED * np.maximum(part.distances[rows], 1.0))
    rows, first, at = rows[better], first[better], at[better]
    corners, shares, distances = part.corners.copy(), part.shares.copy(), part.distances.copy()
    corners[rows] = allowed[near[at, first]][:, None]
    shares[rows], distances[rows] = (1.0, 0.0, 0.0), away[at, first]
    return Places(corners=corners, shares=shares, distances=distances)


def matched_parts(
    target: Surface,
    source: Surface,
    warped: FloatArray,
    weights: FloatArray,
    eyeballs: Sequence[tuple[Eyeball, Eyeball]],
) -> tuple[FloatArray, Mapping[str, tuple[str, ...]]]:
    """Weights (m, j) of the loose points of the target, 0 elsewhere, and which meshes gave them to which.

    Eyeballs turn as the source's do; teeth and other parts that lie on a rigid one go with it; all others, point by
    point, with what of the source is nearest, smoothed.

    :param warped: (m', 3) points of the source, warped onto the target
    :param weights: (m', j) of the source
    :param eyeballs: pairs, of the target and of the source
    """
    result = np.zeros((len(target.points), weights.shape[1]))
    origin: dict[str, set[str]] = {}
    done = np.zeros(len(target.points), bool)
    for ball, other in eyeballs:
        result[ball.points] = _whole(weights[other.points])
        _note(origin, target, ball.points, source, other.points)
        done[ball.points] = True
    taken = np.concatenate([np.zeros(0, np.int64), *(other.points for _, other in eyeballs)])
    # component -> its triangles, of those that are no eyeball
    component = source.component[source.triangles[:, 0]]
    order = np.argsort(component, kind="stable")
    pieces = np.split(source.triangles[order], np.flatnonzero(np.diff(component[order])) + 1)
    eyes = set(source.component[taken].tolist())
    found = {int(source.component[piece[0, 0]]): piece for piece in pieces}
    parts = {number: piece for number, piece in found.items() if number not in eyes}
    rigid = {
        number
        for number in parts
        if number != source.main and bool(weights[source.component == number].mean(axis=0).max(initial=0.0) >= _RIGID)
    }
    rest = []
    left = target.loose[~np.isin(target.component[target.loose], target.component[done])]
    numbers = target.component[left]
    left = left[np.argsort(numbers, kind="stable")]
    cuts = np.flatnonzero(np.diff(target.component[left])) + 1
    loose = np.split(left, cuts) if len(left) else []
    means = _mean_distances([target.points[points] for points in loose], warped, parts)
    for points, mean in zip(loose, means, strict=True):
        # by piece before by point: a tooth whose points each take what is nearest would bend
        among = [number for number in mean if number in rigid]
        chosen = min(among, key=lambda number: (mean[number], number), default=-1)
        small = np.ptp(target.points[points], axis=0).max() <= _SMALL
        if not among or mean[chosen] > min((_PREFERRED if small else 1.0) * min(mean.values()), _NEAR):
            rest.append(points)
            continue
        place = nearest(target.points[points], warped, parts[chosen])
        result[points] = _whole(place.interpolated(weights))
        _note(origin, target, points, source, place.corners[:, 0])
    if rest:
        _follow(np.sort(np.concatenate(rest)), target, source, warped, weights, parts, result, origin)
    return result, {name: tuple(sorted(names)) for name, names in sorted(origin.items())}


def _whole(weights: FloatArray) -> FloatArray:
    """(j,) weights of a part that moves as one: their mean, or the one joint that has nearly all."""
    mean = normalised(weights.mean(axis=0)[None])[0]
    return np.where(mean == mean.max(), 1.0, 0.0) if mean.max() >= _RIGID else mean


def _mean_distances(
    pieces: Sequence[FloatArray], warped: FloatArray, parts: Mapping[int, IntArray]
) -> list[dict[int, float]]:
    """For each of the pieces (k, 3), of every part whose box comes within its reach, the mean distance from it."""
    means: list[dict[int, float]] = [{} for _ in pieces]
    low = np.array([at.min(axis=0) for at in pieces]).reshape(-1, 3) - _NEAR
    high = np.array([at.max(axis=0) for at in pieces]).reshape(-1, 3) + _NEAR
    for number, triangles in parts.items():
        box = warped[triangles.ravel()]
        near = np.flatnonzero(((box.min(axis=0) <= high) & (box.max(axis=0) >= low)).all(axis=1)).tolist()
        if not near:
            continue
        away = nearest(np.concatenate([pieces[i] for i in near]), warped, triangles).distances
        ends = np.cumsum([len(pieces[i]) for i in near])[:-1]
        for i, own in zip(near, np.split(away, ends), strict=True):
            means[i][number] = float(own.mean())
    return means


def _follow(
    points: IntArray,
    target: Surface,
    source: Surface,
    warped: FloatArray,
    weights: FloatArray,
    parts: Mapping[int, IntArray],
    result: FloatArray,
    origin: dict[str, set[str]],
) -> None:
    at = target.points[points]
    main = nearest(at, warped, parts[source.main])
    raw, distances, corners = main.interpolated(weights), main.distances.copy(), main.corners[:, 0].copy()
    loose = [triangles for number, triangles in parts.items() if number != source.main]
    if loose:
        other = nearest(at, warped, np.concatenate(loose))
        nearer = _LOOSE * other.distances < main.distances
        raw[nearer], distances[nearer] = other.interpolated(weights)[nearer], other.distances[nearer]
        corners[nearer] = other.corners[nearer, 0]
    local = target.part_triangles(points, even=True)
    # the nearer a point, the surer its weights: what lies on the source is not blurred, what is far blends widely
    lengths = _BLEND * np.clip(distances / _TRUSTED, _SHARP, 1.0)
    result[points] = normalised(heat_weights(at, local, normalised(raw), lengths))
    _note(origin, target, points, source, corners)


def _note(origin: dict[str, set[str]], target: Surface, points: IntArray, source: Surface, given: IntArray) -> None:
    for number in np.unique(target.mesh[points]):
        own = target.mesh[points] == number
        names = {source.mesh_names[i] for i in np.unique(source.mesh[given[own] if len(given) == len(own) else given])}
        origin.setdefault(target.mesh_names[number], set()).update(names)


def from_face(parts: FaceParts, surface: Surface, source: FaceParts, where: str, smoothing: float) -> Skinning:
    """Skeleton and weights of `source`, on the surface of `parts`.

    On one topology points take the weights of their own; on others, those of places that the warp lays on them.

    :param where: what messages call the source
    :param smoothing: mm
    :raises InputError: no joints or weights on the source, no landmarks on either
    """
    if not source.skeleton.joints or not any(mesh.skin for mesh in source.meshes):
        raise InputError(where, "no joints with skin weights, expected a skinned face")
    twin: FaceParts | None = None  # the source with the meshes of the face, where it is on one topology with it
    with contextlib.suppress(TopologyError):
        twin = in_order(parts, parts.name, source, source.name)
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
        first = np.unique(surface.group, return_index=True)[1]
        away = np.linalg.norm(warp.apply(other.points[other.group[first]]) - surface.points, axis=1)[surface.inside]
    landmarks = np.linalg.norm(warp.apply(other.points[other.landmarks]) - surface.points[surface.landmarks], axis=1)
    p95 = float(np.percentile(away, 95))
    surface_mm = {"mean": float(away.mean()), "rms": float(np.sqrt((away**2).mean())), "p95": p95}
    report = TransferReport(
        source=where,
        same_topology=twin is not None,
        landmarks_mm=float(landmarks.max()),
        surface_mm={**surface_mm, "max": float(away.max())},
        eyeballs=len(pairs),
        parts=origin,
    )
    if (unlike := _unlikeness(surface, other, warp)) > _STRANGE:
        what = f"landmarks lie {unlike:.0%} of their spread from those of {where}, scaled and turned onto them"
        warnings = (*warnings, f"{what}: look at the weights")
    # the source's joints warped: places as the warp moves them, axes turned by the rotation nearest to it there
    to_world = np.asarray(source.skeleton.transform, np.float64)
    worlds = to_world @ np.asarray(source.skeleton.bind_transforms, np.float64)
    places = worlds[:, :3, 3] * source.meters_per_unit * 1000.0
    bind = np.tile(np.eye(4), (len(worlds), 1, 1))
    bind[:, :3, :3] = nearest_rotations(warp.jacobians(places)) @ nearest_rotations(worlds[:, :3, :3])
    bind[:, :3, 3] = warp.apply(places) / (parts.meters_per_unit * 1000.0)
    bind = np.linalg.inv(np.asarray(parts.skeleton.transform, np.float64)) @ bind
    bind[:, :3, :3] = nearest_rotations(bind[:, :3, :3])
    made = with_binds(parts.skeleton, source.skeleton.joints, bind)
    return Skinning(
        skeleton=replace(made, joint_names=source.skeleton.joint_names),
        weights=normalised(result),
        transfer=report,
        warnings=warnings,
    )


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
    target_slits = slits_of(surface)
    source_slits = slits_of(other)
    points = surface.inside
    triangles = other.triangles[(other.component[other.triangles] == other.main).all(axis=1)]
    normals = point_normals(warped, triangles)
    count = len(points)
    places = Places(corners=np.zeros((count, 3), np.int64), shares=np.zeros((count, 3)), distances=np.zeros(count))
    for chosen, allowed in _sides(target_slits, source_slits, points, triangles):
        part = nearest(surface.points[points[chosen]], warped, triangles[allowed])
        part = _turned(part, surface, points[chosen], warped, normals, np.unique(triangles[allowed]))
        places.corners[chosen], places.shares[chosen] = part.corners, part.shares
        places.distances[chosen] = part.distances
    result, origin = matched_parts(surface, other, warped, weights, pairs)
    # the farther off a place is, the less its weights are sure, and the wider they are smoothed
    lengths = np.clip(places.distances / _SURE, _SHARP, _LONGEST) * max(smoothing, _SHARP)
    inside = surface.inside
    local = surface.part_triangles(inside, even=True)
    result[inside] = heat_weights(surface.points[inside], local, normalised(places.interpolated(weights)), lengths)
    return result, origin, places.distances


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
    faces = [(one, eyeballs_of(one)) for one in (target, source)]
    for eye in (slice(36, 42), slice(42, 48)):
        found: list[Eyeball] = []
        for surface, balls in faces:
            assert surface.landmarks is not None
            lids = surface.points[surface.landmarks[eye]]
            away = [float(np.linalg.norm(ball.centre - lids.mean(axis=0))) for ball in balls]
            if away and min(away) <= float(np.linalg.norm(lids[0] - lids[3])):
                found.append(balls[away.index(min(away))])
        if len(found) == 2:
            pairs.append((found[0], found[1]))
    return pairs


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
