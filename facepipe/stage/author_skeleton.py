"""Skeleton, animations, limits, sliders and recipe authored from parts."""

from __future__ import annotations

import json

import numpy as np
from pxr import Sdf, Usd, UsdSkel

from facepipe import tokens
from facepipe.errors import InputError
from facepipe.parts import Animation, BoneLimits, FloatArray, Recipe, Skeleton, Slider
from facepipe.rig.animation import decompose
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


def _transforms(
    animation: Animation, skeleton: Skeleton, samples: int, path: Sdf.Path
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(T, j, 3), (T, j, 4), (T, j, 3); parts of the transform that are not given come from rest."""
    place = {joint: i for i, joint in enumerate(skeleton.joints)}
    missing = [joint for joint in animation.joints if joint not in place]
    if missing:
        raise InputError(path, f"'{missing[0]}' is no joint of the skeleton")
    given = (animation.translations, animation.rotations, animation.scales)
    rest = None
    if any(part is None for part in given):
        rest = decompose(skeleton.rest_transforms[[place[joint] for joint in animation.joints]])
    filled = []
    for i, part in enumerate(given):
        own = np.repeat(rest[i][None], samples, axis=0) if part is None and rest is not None else np.asarray(part)
        if len(own) != samples or own.shape[1] != len(animation.joints) or not np.isfinite(own).all():
            raise InputError(path, f"{own.shape} transforms, expected {samples} x {len(animation.joints)} finite ones")
        filled.append(own)
    return filled[0], filled[1], filled[2]


def author_slider(prim: Usd.Prim, slider: Slider) -> None:
    """Apply a slider to the face prim."""
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
