"""Motion of other tools' stages that is neither joints nor shapes: transforms of prims, and points, that change.

Transforms above a Skeleton go into the motion of its root joints; an unskinned mesh that moves hangs on a joint of its
own, which does. Points over time become shapes, one a sample, that a clip shows in turn: between two samples USD is
linear, and so are weights, so that this is exact.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pxr import Usd, UsdGeom, UsdSkel

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.names import handles
from facepipe.parts import Animation, Blendshape, FaceParts, Mesh, Skeleton, Skin
from facepipe.rig.animation import at_times, between, local_transforms, with_exact_scales
from facepipe.rig.trs import compose, decompose, slerp
from facepipe.stage.values import floats, matrices, matrix, reads_prim

MOST_SHAPES = 512  # samples of points that become shapes
_MOST_NUMBERS = 1 << 26  # of transforms and points over time together
_TOLERANCE = 5e-5  # metres that lines between samples of transforms may be off
_HALVINGS = 9  # of the time between two samples at most
_MOST_BETWEEN = 1 << 23  # numbers of transforms that are looked at between samples
_CHECKED = (0.3, 0.62)  # shares of a span where it is looked at: whole turns don't end at both
_SAME = 1e-6  # of the size: transforms nearer are one
_FLAT = 1e-18  # determinant of a transform that can't be inverted


class Moving(NamedTuple):
    """What changes over time on a stage, before repairs hide it."""

    rate: float  # time codes per second
    codes: FloatArray  # (T,) of transforms
    worlds: Mapping[str, FloatArray]  # path of a mesh or Skeleton -> (T, 4, 4) to the world
    owners: Mapping[str, str]  # path of a mesh -> the nearest prim, itself or above, whose transform changes
    points: Mapping[str, tuple[FloatArray, FloatArray]]  # path of a mesh -> (t,) codes, (t, n, 3)
    rough: bool  # more bends between samples than codes were added for


def moving_of(stage: Usd.Stage, prims: Sequence[Usd.Prim], above: Sequence[Usd.Prim], path: Path) -> Moving:
    """What changes of `prims` and by transforms of those `above` them.

    :raises InputError: more samples than a face can have
    """
    turning = [prim for prim in (*above, *prims) if _xform_codes(prim)]
    codes = np.array(sorted({code for prim in turning for code in _xform_codes(prim)}))
    shown = [prim for prim in prims if prim.IsA(UsdGeom.Mesh) or prim.IsA(UsdSkel.Skeleton)] if len(codes) else []
    sampled = [prim for prim in prims if prim.IsA(UsdGeom.Mesh) and _point_codes(prim)]
    size = 16 * len(codes) * sum(map(_tracks, shown))
    for prim in sampled:
        value = UsdGeom.Mesh(prim).GetPointsAttr().Get(Usd.TimeCode.EarliestTime())
        size += 3 * len(_point_codes(prim)) * len(value or ())
    if size > _MOST_NUMBERS:
        raise InputError(path, f"{size} numbers of transforms and points over time, expected at most {_MOST_NUMBERS}")
    paths = {str(prim.GetPath()) for prim in turning}
    owners: dict[str, str] = {}
    for prim in shown:
        owner = prim
        while owner and not owner.IsPseudoRoot() and str(owner.GetPath()) not in paths:
            owner = owner.GetParent()
        if owner and not owner.IsPseudoRoot():
            owners[str(prim.GetPath())] = str(owner.GetPath())
    moved = [prim for prim in shown if str(prim.GetPath()) in owners]
    codes, places, rough = _worlds(moved, codes, _TOLERANCE / (float(UsdGeom.GetStageMetersPerUnit(stage)) or 1.0))
    worlds = {str(prim.GetPath()): places[:, i] for i, prim in enumerate(moved)}
    points = {str(prim.GetPath()): read for prim in sampled if (read := _points(prim)) is not None}
    return Moving(float(stage.GetTimeCodesPerSecond()) or 24.0, codes, worlds, owners, points, rough)


def _worlds(prims: Sequence[Usd.Prim], codes: FloatArray, within: float) -> tuple[FloatArray, FloatArray, bool]:
    """Codes, and the (T, prims, 4, 4) places of prims in the world there: as `_with_between`.

    Between two samples USD is linear in the values of each operation: in angles, which may be whole turns, and in the
    numbers of matrices.

    :param within: distance that points of a prim may be off between, in stage units
    """
    if not prims:
        return codes, np.zeros((len(codes), 0, 4, 4)), False
    placed = [_placed(prim) for prim in prims]
    reach = np.concatenate([np.full(len(frames), far) for frames, far in placed])

    def at(times: FloatArray) -> FloatArray:
        caches = [UsdGeom.XformCache(Usd.TimeCode(time)) for time in times.tolist()]
        return np.stack([[matrix(cache.GetLocalToWorldTransform(prim)) for prim in prims] for cache in caches])

    def frames_of(places: FloatArray) -> FloatArray:
        """(T, frames, 4, 4): what becomes tracks."""
        return np.concatenate([places[:, i, None] @ frames for i, (frames, _) in enumerate(placed)], axis=1)

    return _with_between(at, frames_of, codes, reach, within)


def _with_between(
    at: Callable[[FloatArray], FloatArray],
    frames_of: Callable[[FloatArray], FloatArray],
    times: FloatArray,
    reach: FloatArray,
    within: float,
) -> tuple[FloatArray, FloatArray, bool]:
    """Times, those given and so many between that lines of translations and scales, and slerp of rotations, are near.

    What is there at all of them comes with it, and whether too many would be needed.

    :param at: (T, ...) what is there at times (T,)
    :param frames_of: (T, n, 4, 4) matrices of it, which the lines are of
    :param reach: (n,) distances of points from a frame's origin
    :param within: distance that they may be off
    """
    start, end = times[:-1], times[1:]
    every, values = [times], [at(times)]
    first, last = values[0][:-1], values[0][1:]
    size = max(values[0].size // max(len(times), 1), 16 * len(reach), 1)
    asked, rough = 0, False
    for halving in range(_HALVINGS + 1):
        asked += (len(_CHECKED) + 1) * len(start) * size
        if not len(start) or asked > _MOST_BETWEEN:
            rough = asked > _MOST_BETWEEN
            break
        bent = np.zeros(len(start), bool)
        for share in _CHECKED:
            # without shear, which no line has
            now = compose(*decompose(frames_of(at(start + share * (end - start))))[:3])
            off = np.abs(now - _line(frames_of(first), frames_of(last), share))
            bent |= ~(off[..., :3, :3].sum(-1).max(-1) * reach + off[..., :3, 3].max(-1) <= within).all(-1)
        rough = halving == _HALVINGS and bool(bent.any())
        if rough or not bent.any():
            break
        start, end, first, last = start[bent], end[bent], first[bent], last[bent]
        middle = (start + end) / 2
        every, values = [*every, middle], [*values, at(middle)]
        first, last = np.concatenate([first, values[-1]]), np.concatenate([values[-1], last])
        start, end = np.concatenate([start, middle]), np.concatenate([middle, end])
    together = np.concatenate(every)
    order = np.argsort(together, kind="stable")
    return together[order], np.concatenate(values)[order], rough


def _line(first: FloatArray, last: FloatArray, share: float) -> FloatArray:
    """(..., 4, 4) between matrices, as animations have it."""
    a, b = decompose(first), decompose(last)
    turned = slerp(a.rotation, b.rotation, np.full((*a.rotation.shape[:-1], 1), share))
    moved, scaled = (one + share * (other - one) for one, other in ((a.translation, b.translation), (a.scale, b.scale)))
    return compose(moved, turned, scaled)


@reads_prim
def _tracks(prim: Usd.Prim) -> int:
    """How many tracks the motion of a prim becomes: of a Skeleton one for each root joint."""
    joints = UsdSkel.Skeleton(prim).GetJointsAttr().Get() if prim.IsA(UsdSkel.Skeleton) else None
    return max(sum("/" not in str(joint) for joint in joints or ()), 1)


@reads_prim
def _placed(prim: Usd.Prim) -> tuple[FloatArray, float]:
    """(k, 4, 4) frames of a prim that tracks will have, itself or root joints, and how far points are from them."""
    if prim.IsA(UsdGeom.Mesh):
        points = floats(UsdGeom.Mesh(prim).GetPointsAttr().Get(Usd.TimeCode.EarliestTime()), 3)
        return np.eye(4)[None], float(np.abs(points[np.isfinite(points)]).max(initial=0.0))
    skeleton = UsdSkel.Skeleton(prim)
    binds = matrices(skeleton.GetBindTransformsAttr().Get())
    rests = matrices(skeleton.GetRestTransformsAttr().Get())
    joints = [str(joint) for joint in skeleton.GetJointsAttr().Get() or ()]
    roots = [i for i, joint in enumerate(joints) if "/" not in joint and i < len(rests)]
    frames = rests[roots] if roots and np.isfinite(rests).all() else np.eye(4)[None]
    return frames, _around(binds)


def _around(binds: FloatArray) -> float:
    """How far from a joint points may be, by (j, 4, 4) bind transforms: twice what all joints span."""
    places = binds[:, :3, 3]
    return 2.0 * float(np.ptp(places, axis=0).max()) if len(places) and np.isfinite(places).all() else 0.0


def _xform_codes(prim: Usd.Prim) -> list[float]:
    codes = UsdGeom.Xformable(prim).GetTimeSamples() if prim.IsA(UsdGeom.Xformable) else []
    return list(codes) if len(codes) > 1 else []


def _point_codes(prim: Usd.Prim) -> list[float]:
    codes = UsdGeom.Mesh(prim).GetPointsAttr().GetTimeSamples()
    return list(codes) if len(codes) > 1 else []


@reads_prim
def _points(prim: Usd.Prim) -> tuple[FloatArray, FloatArray] | None:
    """Codes and (t, n, 3) points of a mesh; None where their number changes."""
    attribute, codes = UsdGeom.Mesh(prim).GetPointsAttr(), _point_codes(prim)
    if len(codes) > MOST_SHAPES:
        return None
    read: list[FloatArray] = []
    for code in codes:
        read.append(floats(attribute.Get(Usd.TimeCode(code)), 3))
        if len(read[-1]) != len(read[0]):  # at once, as many samples may be one array in the file
            return None
    return np.array(codes), np.stack(read)


def with_motion(
    parts: FaceParts, moving: Moving, meshes: Sequence[Usd.Prim], skeleton: Usd.Prim | None
) -> tuple[FaceParts, list[str]]:
    """The face with what moves as motion of joints and shapes, and a line for each kind of it.

    :param meshes: the prims of the parts' meshes, in their order
    :param skeleton: of the parts' skeleton
    """
    named: list[str] = []
    parts = _with_place(parts, moving, skeleton, named)
    parts, rigid = _with_rigid(parts, moving, meshes, skeleton, named)
    # joints place what is skinned, and exporters take the inverse of its own transform
    flat = {mesh.name for mesh in parts.meshes if mesh.skin and abs(np.linalg.det(mesh.transform)) < _FLAT}
    held = (replace(mesh, transform=np.eye(4)) if mesh.name in flat else mesh for mesh in parts.meshes)
    parts = replace(parts, meshes=tuple(held)) if flat else parts
    parts, shown = _with_samples(parts, moving, meshes, named)
    tracks = [one for one in (rigid, shown) if one is not None]
    if not tracks:
        return parts, named
    played = next((one for one in parts.animations if one.name == parts.played), None)
    together = [*([] if played is None else [played]), *tracks]
    times = np.unique(np.concatenate([np.asarray(one.times, float) for one in together if one.times is not None]))
    taken = [one.name for one in parts.animations]
    name = handles([*taken, "motion"], "Animation")[-1] if played is None else played.name
    within = _TOLERANCE / parts.meters_per_unit
    merged, rough = _merged(parts.skeleton, together, times, within)
    whole, lost = with_exact_scales(parts.skeleton, replace(merged, name=name))
    named += [lost] if lost else []
    if rough or moving.rough:
        named.append("transforms over time turn more between their samples than is kept: there they are lines")
    others = tuple(one for one in parts.animations if one is not played)
    return replace(parts, animations=(*others, whole), played=name), named


def _with_place(parts: FaceParts, moving: Moving, skeleton: Usd.Prim | None, named: list[str]) -> FaceParts:
    """The face with its skeleton where it is largest, if it is flat at rest, as what grows from nothing.

    :raises InputError: it is flat at all times
    """
    place = np.asarray(parts.skeleton.transform, dtype=np.float64)
    if not moving.worlds or abs(np.linalg.det(place)) >= _FLAT:
        return parts
    path = "" if skeleton is None else str(skeleton.GetPath())
    worlds = moving.worlds.get(path, place[None])
    sizes = np.abs(np.linalg.det(worlds))
    if sizes.max() < _FLAT:
        raise InputError(path, "its transform is flat at all times, expected one with an inverse")
    largest = int(np.argmax(sizes))
    named.append(f"<{path}>: its transform is flat at rest: that of time {moving.codes[largest]:g} is taken")
    return replace(parts, skeleton=replace(parts.skeleton, transform=worlds[largest]))


def _with_rigid(
    parts: FaceParts, moving: Moving, meshes: Sequence[Usd.Prim], skeleton: Usd.Prim | None, named: list[str]
) -> tuple[FaceParts, Animation | None]:
    """The face with joints for unskinned meshes that move, and the motion of these and of the skeleton's roots."""
    if not moving.worlds:
        return parts, None
    old = parts.skeleton
    to_skeleton = np.linalg.inv(np.asarray(old.transform, dtype=np.float64))
    tracks: dict[str, FloatArray] = {}
    own = moving.worlds.get("" if skeleton is None else str(skeleton.GetPath()))
    if own is not None and len(old.joints) and _changes(own):
        drift = to_skeleton @ own
        for joint, parent, rest in zip(old.joints, old.parents, old.rest_transforms, strict=True):
            if parent < 0:
                tracks[joint] = drift @ rest
        named.append(f"<{moving.owners[str(skeleton.GetPath())]}>: its motion over time is that of the root joints")  # type: ignore[union-attr]
    joints: dict[str, tuple[int, FloatArray, FloatArray, FloatArray]] = {}  # owner -> joint, its rest, bind and track
    changed: list[Mesh] = []
    for mesh, prim in zip(parts.meshes, meshes, strict=True):
        key = str(prim.GetPath())
        worlds = moving.worlds.get(key)
        if mesh.skin is not None or worlds is None or not _changes(worlds):
            changed.append(mesh)
            continue
        rest = to_skeleton @ np.asarray(mesh.transform, dtype=np.float64)
        flat = abs(np.linalg.det(rest)) < _FLAT
        # what is flat at rest, as what grows from nothing, has no inverse to place others by: a joint alone, bound by 1
        owner = key if flat else moving.owners[key]
        bind = np.eye(4) if flat else rest
        number = joints.setdefault(owner, (len(old.joints) + len(joints), rest, bind, to_skeleton @ worlds))[0]
        count = len(mesh.points)
        skin = Skin(
            joint_indices=np.full((count, 1), number, np.int32),
            joint_weights=np.ones((count, 1), np.float32),
            geom_bind_transform=bind,
        )
        changed.append(replace(mesh, skin=skin))
    if joints:
        named.append(f"{', '.join(f'<{owner}>' for owner in joints)}: what moves over time hangs on joints of its own")
        names = handles([*old.joints, *(owner.rpartition("/")[2] for owner in joints)], "joint")[len(old.joints) :]
        _, rests, binds, own_tracks = zip(*joints.values(), strict=True)
        tracks |= zip(names, own_tracks, strict=True)
        grown = replace(
            old,
            joints=(*old.joints, *names),
            joint_names=(*old.joint_names, *names) if old.joint_names else (),
            bind_transforms=np.concatenate([old.bind_transforms, binds]),
            rest_transforms=np.concatenate([old.rest_transforms, rests]),
        )
        parts = replace(parts, meshes=tuple(changed), skeleton=grown)
    if not tracks:
        return parts, None
    return parts, _animation_of(tracks, moving.codes / moving.rate, named)


def _animation_of(tracks: Mapping[str, FloatArray], times: FloatArray, named: list[str]) -> Animation:
    """(T, 4, 4) transforms of joints as an animation; shear is lost, and named."""
    every = np.stack([*tracks.values()], axis=1)
    trs = decompose(every)
    if trs.sheared.any():
        lost = float(np.abs(compose(*trs[:3]) - every).max())
        named.append(f"transforms over time shear what they move, which joints can't: lost up to {lost:.2g}")
    return Animation(
        name="motion",
        times=times,
        joints=tuple(tracks),
        translations=trs.translation.astype(np.float32),
        rotations=trs.rotation.astype(np.float32),
        scales=trs.scale.astype(np.float32),
    )


def _changes(worlds: FloatArray) -> bool:
    size = max(float(np.abs(worlds).max()), 1e-30)
    return bool(np.abs(worlds - worlds[0]).max() > _SAME * size)


def _with_samples(
    parts: FaceParts, moving: Moving, meshes: Sequence[Usd.Prim], named: list[str]
) -> tuple[FaceParts, Animation | None]:
    """The face with a shape for every sample of points but the first, and the clip that shows them in turn."""
    given = {i: moving.points[key] for i, prim in enumerate(meshes) if (key := str(prim.GetPath())) in moving.points}
    found = {i: one for i, one in given.items() if one[1].shape[1] == len(parts.meshes[i].points)}
    codes = np.array(sorted({float(code) for own, _ in found.values() for code in own}))
    # each mesh gets shapes at the samples of all
    if len(codes) > MOST_SHAPES or 3 * len(codes) * sum(one.shape[1] for _, one in found.values()) > _MOST_NUMBERS:
        found = {}
    if left_out := [parts.meshes[i].name for i in given if i not in found]:
        named.append(f"{', '.join(left_out)}: points over time are too many together, or other than its own: left out")
    if not found:
        return parts, None
    names = handles([*parts.shapes, *(f"sample_{number}" for number in range(len(codes)))], "shape")[
        len(parts.shapes) :
    ]
    changed = list(parts.meshes)
    for i, (own, points) in found.items():
        mesh = parts.meshes[i]
        shapes = []
        for number, (left, right, share) in enumerate(zip(*between(own, codes), strict=True)):
            at = points[left] + share * (points[right] - points[left])
            offsets = (at - mesh.points).astype(np.float32)
            moved = np.flatnonzero((offsets != 0).any(axis=1))  # NaN too, which is refused later
            if len(moved):
                own_points = moved.astype(np.int32)
                shapes.append(Blendshape(name=names[number], point_indices=own_points, offsets=offsets[moved]))
        changed[i] = replace(mesh, blendshapes=(*mesh.blendshapes, *shapes))
    parts = replace(parts, meshes=tuple(changed))
    used = [number for number, name in enumerate(names) if name in parts.shapes]
    cast = ", ".join(parts.meshes[i].name for i in found)
    named.append(f"{cast}: {len(codes)} samples of points over time are {len(used)} shapes and a clip")
    if not used:
        return parts, None
    weights = np.eye(len(codes), dtype=np.float32)[:, used]
    shapes_used = tuple(names[number] for number in used)
    return parts, Animation(name="motion", times=codes / moving.rate, shapes=shapes_used, shape_weights=weights)


def _merged(
    skeleton: Skeleton, animations: Sequence[Animation], times: FloatArray, within: float
) -> tuple[Animation, bool]:
    """Animations that play together as one; where two move a joint, the motion of the later is around it.

    And whether that turns more between samples than is kept.

    :param times: of its samples; more come between where two motions of a joint make no line
    :param within: as of `_with_between`
    """
    rest = dict(zip(skeleton.joints, np.asarray(skeleton.rest_transforms, np.float64), strict=True))
    counts = Counter(joint for one in animations for joint in one.joints)
    joints, twice = [*counts], [joint for joint, count in counts.items() if count > 1]

    def locals_at(at: FloatArray) -> FloatArray:
        """(T, j, 4, 4) of `joints`."""
        moved: dict[str, FloatArray] = {}
        for one in animations:
            if one.joints:
                local_of = np.moveaxis(local_transforms(skeleton, _sampled(skeleton, one, at)), 1, 0)
                for joint, local in zip(one.joints, local_of, strict=True):
                    moved[joint] = local @ np.linalg.inv(rest[joint]) @ moved[joint] if joint in moved else local
        return np.stack([moved[joint] for joint in joints], axis=1)

    result, rough = Animation(name="motion", times=times if len(times) > 1 else None), False
    if joints:
        chosen = [joints.index(joint) for joint in twice]
        reach = np.full(len(twice), _around(skeleton.bind_transforms))
        times, local, rough = _with_between(locals_at, lambda local: local[:, chosen], times, reach, within)
        trs = decompose(local)
        result = replace(
            result,
            times=times if len(times) > 1 else None,
            joints=tuple(joints),
            translations=trs.translation.astype(np.float32),
            rotations=trs.rotation.astype(np.float32),
            scales=trs.scale.astype(np.float32),
        )
    weights: dict[str, FloatArray] = {}
    for one in animations:
        if one.shape_weights is not None:
            values = np.asarray(_sampled(skeleton, one, times).shape_weights, np.float32)
            weights |= dict(zip(one.shapes, values.T, strict=True))
    if weights:
        result = replace(result, shapes=tuple(weights), shape_weights=np.stack([*weights.values()], axis=1))
    return result, rough


def _sampled(skeleton: Skeleton, animation: Animation, times: FloatArray) -> Animation:
    """An animation at `times`; a pose is the same at all of them."""
    if animation.times is not None:
        return at_times(skeleton, animation, times)
    repeated = np.zeros(len(times), np.int64)
    fields = ("translations", "rotations", "scales", "coefficients", "shape_weights")
    held = {field: value[repeated] for field in fields if (value := getattr(animation, field)) is not None}
    return replace(animation, times=times, **held)
