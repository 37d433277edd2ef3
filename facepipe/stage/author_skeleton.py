"""Skeleton, animations, limits, sliders and recipe authored from parts."""

from __future__ import annotations

import json
from collections.abc import Iterable

import numpy as np
from pxr import Sdf, Usd, UsdSkel

from facepipe import tokens
from facepipe.errors import InputError
from facepipe.parts import Animation, BoneLimits, FloatArray, Recipe, Skeleton, Slider
from facepipe.rig.animation import local_transforms
from facepipe.rig.trs import decompose
from facepipe.stage.property_names import check_property_name
from facepipe.stage.values import to_floats, to_matrices, to_matrix, to_quatf, to_vec3f, to_vec3h


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
    prim.CreateBindTransformsAttr(to_matrices(skeleton.bind_transforms))
    prim.CreateRestTransformsAttr(to_matrices(skeleton.rest_transforms))
    if not np.array_equal(skeleton.transform, np.eye(4)):
        prim.AddTransformOp().Set(to_matrix(skeleton.transform))
    return prim


def author_limits(prim: Usd.Prim, limits: BoneLimits) -> None:
    """Write bone limits on a Skeleton prim."""
    prim.ApplyAPI(tokens.BONE_LIMITS_API)
    prim.GetAttribute(tokens.LIMITS_LOWER).Set(to_floats(limits.lower))
    prim.GetAttribute(tokens.LIMITS_UPPER).Set(to_floats(limits.upper))


def author_animation(stage: Usd.Stage, path: Sdf.Path, animation: Animation, skeleton: Skeleton) -> None:
    """Define a SkelAnimation; what it leaves out of a joint's transform is authored from rest."""
    prim = UsdSkel.Animation.Define(stage, path)
    rate = stage.GetTimeCodesPerSecond()
    times = [Usd.TimeCode.Default()] if animation.times is None else [Usd.TimeCode(t * rate) for t in animation.times]
    if animation.joints:
        prim.CreateJointsAttr(list(animation.joints))
        translations, rotations, scales = _transforms(animation, skeleton, len(times), path)
        for i, time in enumerate(times):
            prim.CreateTranslationsAttr().Set(to_vec3f(translations[i]), time)
            prim.CreateRotationsAttr().Set(to_quatf(rotations[i]), time)
            prim.CreateScalesAttr().Set(to_vec3h(scales[i]), time)
    if animation.coefficients is not None:
        prim.GetPrim().ApplyAPI(tokens.POSE_API)
        for i, time in enumerate(times):
            prim.GetPrim().GetAttribute(tokens.BONE_COEFFICIENTS).Set(to_floats(animation.coefficients[i]), time)
    if animation.shapes and animation.shape_weights is not None:
        prim.CreateBlendShapesAttr(list(animation.shapes))
        for i, time in enumerate(times):
            prim.CreateBlendShapeWeightsAttr().Set(to_floats(animation.shape_weights[i]), time)


def author_time_range(stage: Usd.Stage, animations: Iterable[Animation]) -> None:
    """Write the first and last time of the clips as the stage's time range; nothing where there are only poses."""
    times = [float(time) for one in animations if one.times is not None for time in one.times]
    if times:
        rate = stage.GetTimeCodesPerSecond()
        stage.SetStartTimeCode(min(times) * rate)
        stage.SetEndTimeCode(max(times) * rate)


def _transforms(
    animation: Animation, skeleton: Skeleton, samples: int, path: Sdf.Path
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(T, j, 3), (T, j, 4), (T, j, 3): as given, or what the rig makes of what is given."""
    given = (animation.translations, animation.rotations, animation.scales)
    shape = (samples, len(animation.joints))
    for part in (*given, animation.coefficients):
        if part is not None and (np.shape(part)[:2] != shape or not np.isfinite(part).all()):
            raise InputError(path, f"{np.shape(part)} transforms, expected {samples} x {shape[1]} finite ones")
    trs = decompose(local_transforms(skeleton, animation))
    translations, rotations, scales = given
    kept = animation.coefficients is None or all(part is not None for part in given)
    return (
        translations if kept and translations is not None else trs.translation,
        rotations if kept and rotations is not None else trs.rotation,
        scales if kept and scales is not None else trs.scale,
    )


def author_slider(prim: Usd.Prim, slider: Slider) -> None:
    """Apply a slider to the face prim.

    :raises InputError: a name that USD can't hold
    """
    check_property_name(prim.GetPath(), "slider", slider.name, tokens.SLIDER_API)
    prim.ApplyAPI(tokens.SLIDER_API, slider.name)
    prefix = f"{tokens.SLIDER_PREFIX}{slider.name}:"
    for name in ("group", "default", "minimum", "maximum"):
        prim.GetAttribute(prefix + name).Set(getattr(slider, name))
    if slider.value is not None:
        prim.GetAttribute(f"{prefix}value").Set(slider.value)
    if slider.channels:
        joints, channels, gains = zip(*slider.channels, strict=True)
        prim.GetAttribute(f"{prefix}joints").Set(list(joints))
        prim.GetAttribute(f"{prefix}channels").Set(list(channels))
        prim.GetAttribute(f"{prefix}channelGains").Set(list(gains))
    if slider.shapes:
        shapes, gains = zip(*slider.shapes, strict=True)
        prim.GetAttribute(f"{prefix}shapes").Set(list(shapes))
        prim.GetAttribute(f"{prefix}shapeGains").Set(list(gains))


def author_recipe(prim: Usd.Prim, recipe: Recipe) -> None:
    """Write the recipe on the face prim."""
    prim.ApplyAPI(tokens.RECIPE_API)
    prim.GetAttribute(tokens.RECIPE_VERB).Set(recipe.verb)
    prim.GetAttribute(tokens.RECIPE_SOURCES).Set(list(recipe.sources))
    prim.GetAttribute(tokens.RECIPE_DIGESTS).Set(list(recipe.digests))
    prim.GetAttribute(tokens.RECIPE_OPTIONS).Set(json.dumps(dict(recipe.options), sort_keys=True))
    prim.GetAttribute(tokens.RECIPE_VERSION).Set(recipe.version)
