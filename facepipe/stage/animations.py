"""Author poses and clips of a face, or what of them changed."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from pxr import Sdf, Usd, UsdSkel

from facepipe.core import tokens
from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.parts import Animation, Skeleton
from facepipe.rig.animation import local_transforms
from facepipe.rig.trs import decompose
from facepipe.stage.api_schemas import apply_schema, put_value, schema_attribute
from facepipe.stage.prims import author_name, editable, free_path
from facepipe.stage.values import same, to_floats, to_quatf, to_vec3f, to_vec3h

_ATTRIBUTES: dict[str, tuple[str, Callable[[Any], Any]]] = {
    "joints": ("joints", list),
    "translations": ("translations", to_vec3f),
    "rotations": ("rotations", to_quatf),
    "scales": ("scales", to_vec3h),
    "coefficients": (tokens.BONE_COEFFICIENTS, to_floats),
    "shapes": ("blendShapes", list),
    "shape_weights": ("blendShapeWeights", to_floats),
}


def author_animation(stage: Usd.Stage, path: Sdf.Path, animation: Animation, skeleton: Skeleton) -> None:
    """Define a SkelAnimation; what it leaves out of a joint's transform is authored from rest."""
    done = _completed(animation, skeleton, path)
    prim = UsdSkel.Animation.Define(stage, path)
    author_name(prim.GetPrim(), animation)
    _write(prim, done, tuple(_ATTRIBUTES))


def author_source(skeleton: Usd.Prim, animation: Sdf.Path) -> None:
    """Author what a Skeleton plays, where something opens the stage."""
    UsdSkel.BindingAPI.Apply(skeleton).CreateAnimationSourceRel().SetTargets([animation])


def author_animation_changes(
    face: Usd.Prim, prims: Sequence[Usd.Prim], old: Sequence[Animation], new: Sequence[Animation], skeleton: Skeleton
) -> tuple[str, ...]:
    """Author on a face what of its animations differs, matched by name; one line each.

    Prims of animations that are gone are deactivated.

    :param prims: what `old` was read from
    :param skeleton: that `new` refers to
    """
    present = list(zip(prims, old, strict=True))
    lines = []
    for animation in new:
        number = next((i for i, (_, known) in enumerate(present) if known.name == animation.name), None)
        if number is None:
            author_animation(
                face.GetStage(), free_path(face, tokens.ANIMATIONS_SCOPE, animation.name), animation, skeleton
            )
            lines.append(f"{animation.name}: added")
            continue
        prim, before = present.pop(number)
        done = _completed(animation, skeleton, prim.GetPath())
        if same(before, animation):
            continue
        pairs = {field: (getattr(before, field), getattr(done, field)) for field in _ATTRIBUTES}
        if before.scales is not None and done.scales is not None:  # halves on the stage
            pairs["scales"] = (_halves(before.scales), _halves(done.scales))
        retimed = not same(before.times, done.times)  # then all samples are written anew
        fields = [
            field
            for field, (present, own) in pairs.items()
            if not same(present, own) or (retimed and own is not None and len(own))
        ]
        if fields:
            _write(UsdSkel.Animation(editable(prim)), done, fields)
            lines.append(f"{animation.name}: {', '.join(fields)}")
    for prim, before in present:
        # inactive: a layer cannot remove a prim that a weaker one holds
        editable(prim).SetActive(False)
        lines.append(f"{before.name}: removed")
    if not same([animation.times for animation in old], [animation.times for animation in new]):
        author_time_range(face.GetStage(), new)
    return tuple(lines)


def _halves(scales: FloatArray | None) -> FloatArray:
    """Scales in the precision of SkelAnimation."""
    with np.errstate(over="ignore"):
        return np.asarray(np.asarray(scales, dtype=np.float32).astype(np.float16))


def author_time_range(stage: Usd.Stage, animations: Iterable[Animation]) -> None:
    """Write the first and last time of the clips as the stage's time range; nothing where there are only poses."""
    times = [float(time) for animation in animations if animation.times is not None for time in animation.times]
    if times:
        rate = stage.GetTimeCodesPerSecond()
        stage.SetStartTimeCode(min(times) * rate)
        stage.SetEndTimeCode(max(times) * rate)


def _write(prim: UsdSkel.Animation, animation: Animation, fields: Collection[str]) -> None:
    """Write the named fields of a completed animation, in place of what the prim has; None hides that."""
    rate = prim.GetPrim().GetStage().GetTimeCodesPerSecond()
    times = [Usd.TimeCode.Default()] if animation.times is None else [Usd.TimeCode(t * rate) for t in animation.times]
    if "coefficients" in fields and animation.coefficients is not None:
        apply_schema(prim.GetPrim(), tokens.POSE_API)
    for field in fields:
        name, to_usd = _ATTRIBUTES[field]
        values = getattr(animation, field)
        if values is None or to_usd is list:
            put_value(prim.GetPrim(), name, list(values) if values else None)
            continue
        attribute = schema_attribute(prim.GetPrim(), name)
        attribute.Clear()
        for time, row in zip(times, values, strict=True):
            attribute.Set(to_usd(row), time)


def _completed(animation: Animation, skeleton: Skeleton, where: object) -> Animation:
    """The animation as it is authored: all parts of joint transforms or none, shapes with weights or none.

    :raises InputError: transforms that are not finite or not one per joint and sample
    """
    if not animation.shapes or animation.shape_weights is None:
        animation = replace(animation, shapes=(), shape_weights=None)
    if not animation.joints:
        return replace(animation, translations=None, rotations=None, scales=None, coefficients=None)
    # (T, j, 3), (T, j, 4), (T, j, 3): as given, or what the rig makes of what is given
    samples = animation.samples
    given = (animation.translations, animation.rotations, animation.scales)
    shape = (samples, len(animation.joints))
    for part in (*given, animation.coefficients):
        if part is not None and (np.shape(part)[:2] != shape or not np.isfinite(part).all()):
            raise InputError(where, f"{np.shape(part)} transforms, expected {samples} x {shape[1]} finite ones")
    trs = decompose(local_transforms(skeleton, animation))
    translations, rotations, scales = given
    if not np.isfinite(_halves(trs.scale)).all():
        raise InputError(where, "scales too large for the half precision of SkelAnimation, expected them below 65520")
    kept = animation.coefficients is None or all(part is not None for part in given)
    translations, rotations, scales = (
        translations if kept and translations is not None else trs.translation,
        rotations if kept and rotations is not None else trs.rotation,
        scales if kept and scales is not None else trs.scale,
    )
    return replace(animation, translations=translations, rotations=rotations, scales=scales)
