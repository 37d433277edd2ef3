"""Motion of other tools' stages that is neither joints nor shapes: transforms of prims, and points, that change.

Transforms above a Skeleton go into the motion of its root joints; an unskinned mesh that moves hangs on a joint of its
own, which does. Points over time become shapes, one a sample, that a clip shows in turn: between two samples USD is
linear, and so are weights, so that this is exact.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pxr import Usd, UsdGeom, UsdSkel

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.names import handles
from facepipe.parts import Animation, Blendshape, FaceParts, Mesh, Skeleton, Skin
from facepipe.rig.animation import at_times, local_transforms, with_exact_scales
from facepipe.rig.trs import decompose
from facepipe.stage.guard import reads_prim
from facepipe.stage.values import floats, matrix

MOST_SHAPES = 512  # samples of points that become shapes
_MOST_NUMBERS = 1 << 26  # of transforms and points over time together
_SAME = 1e-6  # of the size: transforms nearer are one


class Moving(NamedTuple):
    """What changes over time on a stage, before repairs hide it."""

    rate: float  # time codes per second
    codes: FloatArray  # (T,) of transforms
    worlds: Mapping[str, FloatArray]  # path of a mesh or Skeleton -> (T, 4, 4) to the world
    owners: Mapping[str, str]  # path of a mesh -> the nearest prim, itself or above, whose transform changes
    points: Mapping[str, tuple[FloatArray, FloatArray]]  # path of a mesh -> (t,) codes, (t, n, 3)


def moving_of(stage: Usd.Stage, prims: Sequence[Usd.Prim], above: Sequence[Usd.Prim], path: Path) -> Moving:
    """What changes of `prims` and by transforms of those `above` them.

    :raises InputError: more samples than a face can have
    """
    turning = [prim for prim in (*above, *prims) if _xform_codes(prim)]
    codes = np.array(sorted({code for prim in turning for code in _xform_codes(prim)}))
    shown = [prim for prim in prims if prim.IsA(UsdGeom.Mesh) or prim.IsA(UsdSkel.Skeleton)] if len(codes) else []
    sampled = [prim for prim in prims if prim.IsA(UsdGeom.Mesh) and _point_codes(prim)]
    size = 16 * len(codes) * len(shown)
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
    caches = [UsdGeom.XformCache(Usd.TimeCode(code)) for code in codes]
    worlds = {
        str(prim.GetPath()): np.stack([matrix(cache.GetLocalToWorldTransform(prim)) for cache in caches])
        for prim in shown
        if str(prim.GetPath()) in owners
    }
    points = {str(prim.GetPath()): read for prim in sampled if (read := _points(prim)) is not None}
    return Moving(float(stage.GetTimeCodesPerSecond()) or 24.0, codes, worlds, owners, points)


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
    read = [floats(attribute.Get(Usd.TimeCode(code)), 3) for code in codes]
    return (np.array(codes), np.stack(read)) if len({len(one) for one in read}) == 1 else None


def with_motion(
    parts: FaceParts, moving: Moving, meshes: Sequence[Usd.Prim], skeleton: Usd.Prim | None
) -> tuple[FaceParts, list[str]]:
    """The face with what moves as motion of joints and shapes, and a line for each kind of it.

    :param meshes: the prims of the parts' meshes, in their order
    :param skeleton: of the parts' skeleton
    """
    named: list[str] = []
    parts, rigid = _with_rigid(parts, moving, meshes, skeleton, named)
    parts, shown = _with_samples(parts, moving, meshes, named)
    tracks = [one for one in (rigid, shown) if one is not None]
    if not tracks:
        return parts, named
    played = next((one for one in parts.animations if one.name == parts.played), None)
    together = [*([] if played is None else [played]), *tracks]
    times = np.unique(np.concatenate([np.asarray(one.times, float) for one in together if one.times is not None]))
    taken = [one.name for one in parts.animations]
    name = handles([*taken, "motion"], "Animation")[-1] if played is None else played.name
    whole, lost = with_exact_scales(parts.skeleton, replace(_merged(parts.skeleton, together, times), name=name))
    named += [lost] if lost else []
    others = tuple(one for one in parts.animations if one is not played)
    return replace(parts, animations=(*others, whole), played=name), named


def _with_rigid(
    parts: FaceParts, moving: Moving, meshes: Sequence[Usd.Prim], skeleton: Usd.Prim | None, named: list[str]
) -> tuple[FaceParts, Animation | None]:
    """The face with joints for unskinned meshes that move, and the motion of these and of the skeleton's roots."""
    old = parts.skeleton
    place = np.asarray(old.transform, dtype=np.float64)
    to_skeleton = np.linalg.inv(place)
    tracks: dict[str, FloatArray] = {}
    own = moving.worlds.get("" if skeleton is None else str(skeleton.GetPath()))
    if own is not None and len(old.joints) and _changes(own):
        drift = to_skeleton @ own
        for joint, parent, rest in zip(old.joints, old.parents, old.rest_transforms, strict=True):
            if parent < 0:
                tracks[joint] = drift @ rest
        named.append(f"<{moving.owners[str(skeleton.GetPath())]}>: its motion over time is that of the root joints")  # type: ignore[union-attr]
    joints: dict[str, tuple[str, FloatArray]] = {}  # owner -> joint, its world at rest in skeleton space
    changed: list[Mesh] = []
    for mesh, prim in zip(parts.meshes, meshes, strict=True):
        key = str(prim.GetPath())
        worlds = moving.worlds.get(key)
        if mesh.skin is not None or worlds is None or not _changes(worlds):
            changed.append(mesh)
            continue
        owner = moving.owners[key]
        if owner not in joints:
            base = handles([*old.joints, *(name for name, _ in joints.values()), owner.rpartition("/")[2]], "joint")[-1]
            bind = to_skeleton @ np.asarray(mesh.transform, dtype=np.float64)
            joints[owner] = base, bind
            tracks[base] = to_skeleton @ worlds
        number, count = len(old.joints) + [*joints].index(owner), len(mesh.points)
        skin = Skin(
            joint_indices=np.full((count, 1), number, np.int32),
            joint_weights=np.ones((count, 1), np.float32),
            geom_bind_transform=to_skeleton @ np.asarray(mesh.transform, dtype=np.float64),
        )
        changed.append(replace(mesh, skin=skin))
    if joints:
        named.append(f"{', '.join(f'<{owner}>' for owner in joints)}: what moves over time hangs on joints of its own")
        binds = np.stack([bind for _, bind in joints.values()])
        grown = replace(
            old,
            joints=(*old.joints, *(name for name, _ in joints.values())),
            joint_names=(*old.joint_names, *(name for name, _ in joints.values())) if old.joint_names else (),
            bind_transforms=np.concatenate([old.bind_transforms, binds]),
            rest_transforms=np.concatenate([old.rest_transforms, binds]),
        )
        parts = replace(parts, meshes=tuple(changed), skeleton=grown)
    if not tracks:
        return parts, None
    trs = decompose(np.stack([*tracks.values()], axis=1))
    return parts, Animation(
        name="motion",
        times=moving.codes / moving.rate,
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
    found = {i: moving.points[key] for i, prim in enumerate(meshes) if (key := str(prim.GetPath())) in moving.points}
    found = {i: one for i, one in found.items() if one[1].shape[1] == len(parts.meshes[i].points)}
    codes = np.array(sorted({float(code) for own, _ in found.values() for code in own}))
    if not found or len(codes) > MOST_SHAPES:
        return parts, None
    names = handles([*parts.shapes, *(f"sample_{number}" for number in range(len(codes)))], "shape")[
        len(parts.shapes) :
    ]
    changed = list(parts.meshes)
    for i, (own, points) in found.items():
        mesh = parts.meshes[i]
        shapes = []
        for number, code in enumerate(codes):
            at = np.stack([np.interp(code, own, one) for one in points.reshape(len(own), -1).T]).reshape(-1, 3)
            offsets = (at - mesh.points).astype(np.float32)
            moved = np.flatnonzero(np.abs(offsets).max(axis=1) > 0)
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


def _merged(skeleton: Skeleton, animations: Sequence[Animation], times: FloatArray) -> Animation:
    """Animations that play together as one at `times`; where two move a joint, the motion of the later is around it."""
    result = Animation(name="motion", times=times if len(times) > 1 else None)
    moved: dict[str, FloatArray] = {}
    weights: dict[str, FloatArray] = {}
    for one in animations:
        sampled = one if one.times is None else at_times(skeleton, one, times)
        if one.times is None:
            repeated = np.zeros(len(times), np.int64)
            sampled = replace(
                one,
                times=times,
                **{
                    field: value[repeated]
                    for field in ("translations", "rotations", "scales", "coefficients", "shape_weights")
                    if (value := getattr(one, field)) is not None
                },
            )
        if sampled.joints:
            rest = dict(zip(skeleton.joints, np.asarray(skeleton.rest_transforms, np.float64), strict=True))
            local_of = np.moveaxis(local_transforms(skeleton, sampled), 1, 0)
            for joint, local in zip(sampled.joints, local_of, strict=True):
                around = local @ np.linalg.inv(rest[joint])
                moved[joint] = around @ moved[joint] if joint in moved else local
        if sampled.shape_weights is not None:
            weights |= dict(zip(sampled.shapes, np.asarray(sampled.shape_weights, np.float32).T, strict=True))
    if moved:
        trs = decompose(np.stack([*moved.values()], axis=1))
        result = replace(
            result,
            joints=tuple(moved),
            translations=trs.translation.astype(np.float32),
            rotations=trs.rotation.astype(np.float32),
            scales=trs.scale.astype(np.float32),
        )
    if weights:
        result = replace(result, shapes=tuple(weights), shape_weights=np.stack([*weights.values()], axis=1))
    return result
