"""Skeleton, bone limits, animations and recipe of a face: read as parts, and authored from them."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdSkel

from facepipe.core import tokens
from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError, SchemaError, TopologyError
from facepipe.core.reading import check_json, check_values
from facepipe.parts import Animation, BoneLimits, Recipe, Skeleton
from facepipe.rig.animation import local_transforms
from facepipe.rig.trs import decompose
from facepipe.stage.prims import (
    apply_schema,
    author_name,
    editable,
    exact_name,
    free_path,
    label,
    put_value,
    schema_attribute,
)
from facepipe.stage.values import (
    floats,
    matrices,
    matrix,
    quaternions,
    reads_prim,
    same,
    to_floats,
    to_matrices,
    to_matrix,
    to_quatf,
    to_vec3f,
    to_vec3h,
)

VRM_LEVELS = 16  # of JSON
_ATTRIBUTES: dict[str, tuple[str, Callable[[Any], Any]]] = {
    "joints": ("joints", list),
    "translations": ("translations", to_vec3f),
    "rotations": ("rotations", to_quatf),
    "scales": ("scales", to_vec3h),
    "coefficients": (tokens.BONE_COEFFICIENTS, to_floats),
    "shapes": ("blendShapes", list),
    "shape_weights": ("blendShapeWeights", to_floats),
}


@reads_prim
def read_skeleton(prim: Usd.Prim) -> Skeleton:
    """A Skeleton prim.

    :raises TopologyError: as many bind or rest transforms as joints are expected
    :raises SchemaError: non-finite transforms, or a child joint before its parent
    """
    skeleton = UsdSkel.Skeleton(prim)
    where = str(prim.GetPath())
    joints = tuple(str(joint) for joint in skeleton.GetJointsAttr().Get() or [])
    bind = matrices(skeleton.GetBindTransformsAttr().Get())
    rest = matrices(skeleton.GetRestTransformsAttr().Get())
    for name, transforms in (("bindTransforms", bind), ("restTransforms", rest)):
        if len(transforms) != len(joints):
            raise TopologyError(f"{where}.{name}", f"{len(transforms)} transforms, expected {len(joints)}")
        if not np.isfinite(transforms).all():
            raise SchemaError(f"{where}.{name}", "NaN or infinity, expected finite numbers")
    attribute = skeleton.GetJointNamesAttr()
    names = tuple(str(name) for name in attribute.Get() or [])
    if names and len(names) != len(joints):
        raise TopologyError(attribute.GetPath(), f"{len(names)} names, expected {len(joints)}")
    world = matrix(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(Usd.TimeCode.Default()))
    result = Skeleton(
        name=prim.GetName(),
        joints=joints,
        joint_names=Skeleton(joints=joints).called(names).joint_names if names else (),
        bind_transforms=bind,
        rest_transforms=rest,
        transform=world,
    )
    # world matrices are multiplied in this order: a parent that came later would have none yet
    late = np.flatnonzero(result.parents >= np.arange(len(joints)))
    if late.size or len(set(joints)) != len(joints):
        raise SchemaError(f"{where}.joints", f"'{joints[late[0]] if late.size else joints}' out of order or twice")
    return result


@reads_prim
def read_limits(prim: Usd.Prim, joint_count: int) -> BoneLimits | None:
    """Bone limits of a Skeleton prim, where it has some."""
    lower = floats(prim.GetAttribute(tokens.LIMITS_LOWER).Get())
    upper = floats(prim.GetAttribute(tokens.LIMITS_UPPER).Get())
    if not lower.size and not upper.size:
        return None
    for name, values in ((tokens.LIMITS_LOWER, lower), (tokens.LIMITS_UPPER, upper)):
        if len(values) != 9 * joint_count:
            raise TopologyError(f"{prim.GetPath()}.{name}", f"{len(values)} values, expected {9 * joint_count}")
    return BoneLimits(lower=lower.reshape(-1, 9), upper=upper.reshape(-1, 9))


@reads_prim
def read_animation(prim: Usd.Prim, name: str | None = None) -> Animation:
    """A SkelAnimation prim: its time samples, or its default values as one pose.

    :param name: what it is called, where several have its exact name
    :raises TopologyError: arrays that don't fit the joints or shapes
    """
    animation, name = UsdSkel.Animation(prim), exact_name(prim) if name is None else name
    joints = tuple(str(joint) for joint in animation.GetJointsAttr().Get() or [])
    shapes = tuple(str(shape) for shape in animation.GetBlendShapesAttr().Get() or [])
    coefficients = prim.GetAttribute(tokens.BONE_COEFFICIENTS)
    attributes = [
        animation.GetTranslationsAttr(),
        animation.GetRotationsAttr(),
        animation.GetScalesAttr(),
        animation.GetBlendShapeWeightsAttr(),
        *([coefficients] if coefficients else []),
    ]
    # the codes of all attributes: where one has no sample of its own, USD interpolates it
    codes = sorted({code for attribute in attributes for code in attribute.GetTimeSamples()})
    times = [Usd.TimeCode(code) for code in codes] or [Usd.TimeCode.Default()]
    rate = prim.GetStage().GetTimeCodesPerSecond() or 24.0

    def samples(attribute: Usd.Attribute, count: int, width: int, quaternion: bool = False) -> FloatArray | None:
        if not attribute or not attribute.HasAuthoredValue():
            return None
        read = [attribute.Get(time) for time in times]
        rows = [quaternions(sample) if quaternion else floats(sample, width) for sample in read]
        other = next((len(row) for row in rows if len(row) != count), None)
        if other is not None:
            raise TopologyError(attribute.GetPath(), f"{other} values at a time sample, expected {count}")
        return np.stack(rows) if count else None

    weights = samples(attributes[3], len(shapes), 1)
    return Animation(
        name=name,
        label=label(prim, name),
        times=np.array(codes) / rate if codes else None,
        joints=joints,
        translations=samples(attributes[0], len(joints), 3),
        rotations=samples(attributes[1], len(joints), 4, quaternion=True),
        scales=samples(attributes[2], len(joints), 3),
        coefficients=samples(coefficients, len(joints), 9),
        shapes=shapes,
        shape_weights=None if weights is None else weights[..., 0],
    )


@reads_prim
def read_recipe(prim: Usd.Prim) -> Recipe | None:
    """The recipe of the face prim, where it has one."""
    verb = prim.GetAttribute(tokens.RECIPE_VERB).Get()
    if not verb:
        return None
    text = str(prim.GetAttribute(tokens.RECIPE_OPTIONS).Get() or "{}")  # of whatever type the layer says
    where = f"{prim.GetPath()}.{tokens.RECIPE_OPTIONS}"
    check_values(where, text.encode())
    try:
        options = json.loads(text)
    except (ValueError, RecursionError):
        raise SchemaError(where, "no JSON, expected a JSON object") from None
    return Recipe(
        verb=str(verb),
        sources=tuple(prim.GetAttribute(tokens.RECIPE_SOURCES).Get() or ()),
        digests=tuple(prim.GetAttribute(tokens.RECIPE_DIGESTS).Get() or ()),
        options=options,
        version=str(prim.GetAttribute(tokens.RECIPE_VERSION).Get() or ""),
    )


@reads_prim
def read_vrm(prim: Usd.Prim) -> dict[str, object]:
    """What VRM says of the avatar that the face prim is; empty for most faces.

    :raises SchemaError: no JSON object
    :raises InputError: one of more levels than any avatar has
    """
    text = str(prim.GetAttribute(tokens.VRM).Get() or "")
    if not text:
        return {}
    where = f"{prim.GetPath()}.{tokens.VRM}"
    check_values(where, text.encode())
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        found = None
    if not isinstance(found, dict):
        raise SchemaError(where, "no JSON object, expected one")
    check_json(where, found, VRM_LEVELS)
    return found


def vrm_text(vrm: Mapping[str, object]) -> str:
    """The text that the face prim has of it; empty for none."""
    return json.dumps(dict(vrm), sort_keys=True, ensure_ascii=False) if vrm else ""


def author_skeleton(stage: Usd.Stage, path: Sdf.Path, skeleton: Skeleton) -> UsdSkel.Skeleton:
    """Define the Skeleton prim.

    :raises InputError: transforms that are not finite or not one per joint
    """
    prim = UsdSkel.Skeleton.Define(stage, path)
    UsdSkel.BindingAPI.Apply(prim.GetPrim())
    for name, transforms in (("bind", skeleton.bind_transforms), ("rest", skeleton.rest_transforms)):
        if len(transforms) != len(skeleton.joints) or not np.isfinite(transforms).all():
            raise InputError(path, f"{len(transforms)} {name} transforms, expected {len(skeleton.joints)} finite ones")
    prim.CreateJointsAttr(list(skeleton.joints))
    if skeleton.joint_names:
        prim.CreateJointNamesAttr(list(skeleton.joint_names))
    prim.CreateBindTransformsAttr(to_matrices(skeleton.bind_transforms))
    prim.CreateRestTransformsAttr(to_matrices(skeleton.rest_transforms))
    if not np.array_equal(skeleton.transform, np.eye(4)):
        prim.AddTransformOp().Set(to_matrix(skeleton.transform))
    return prim


def author_limits(prim: Usd.Prim, limits: BoneLimits) -> None:
    """Write bone limits on a Skeleton prim."""
    apply_schema(prim, tokens.BONE_LIMITS_API)
    put_value(prim, tokens.LIMITS_LOWER, to_floats(limits.lower))
    put_value(prim, tokens.LIMITS_UPPER, to_floats(limits.upper))


def author_recipe(prim: Usd.Prim, recipe: Recipe) -> None:
    """Write the recipe on the face prim."""
    apply_schema(prim, tokens.RECIPE_API)
    put_value(prim, tokens.RECIPE_VERB, recipe.verb)
    put_value(prim, tokens.RECIPE_SOURCES, list(recipe.sources))
    put_value(prim, tokens.RECIPE_DIGESTS, list(recipe.digests))
    put_value(prim, tokens.RECIPE_OPTIONS, json.dumps(dict(recipe.options), sort_keys=True))
    put_value(prim, tokens.RECIPE_VERSION, recipe.version)


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
