"""Skeleton, limits, sliders and recipe authored from parts."""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np
from pxr import Sdf, Usd, UsdSkel

from facepipe.core import tokens
from facepipe.core.errors import InputError
from facepipe.parts import BoneLimits, Recipe, Skeleton, Slider
from facepipe.rig.sliders import curves_fault, sliders_fault
from facepipe.stage.api_schemas import apply_schema, put_value
from facepipe.stage.property_names import check_property_name
from facepipe.stage.values import to_floats, to_matrices, to_matrix


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


def check_sliders(where: object, sliders: Sequence[Slider]) -> None:
    """Check what the sliders of a face must be together, and their curves.

    :raises InputError: a damaged curve, or a mirror that is not mutual
    """
    found = sliders_fault(sliders)
    if found:
        raise InputError(f"{where} -> slider {found[0]}", found[1])


def author_sliders(prim: Usd.Prim, sliders: Sequence[Slider]) -> None:
    """Apply sliders to the face prim.

    :raises InputError: a name that USD can't hold, or damaged curves
    """
    for slider in sliders:
        check_property_name(prim.GetPath(), "slider", slider.name, tokens.SLIDER_API)
        fault = curves_fault(slider)
        if fault:
            raise InputError(f"{prim.GetPath()} -> slider {slider.name}", fault)
    for slider in sliders:  # all before any attribute: USD composes the prim's definition anew after each
        apply_schema(prim, tokens.SLIDER_API, slider.name)
    for slider in sliders:
        _author_slider(prim, slider)


def _author_slider(prim: Usd.Prim, slider: Slider) -> None:
    prefix = f"{tokens.SLIDER_PREFIX}{slider.name}:"
    for name in ("group", "default", "minimum", "maximum"):
        put_value(prim, prefix + name, getattr(slider, name))
    put_value(prim, f"{prefix}value", slider.value)
    for fields, rows in (
        (("joints", "channels", "channelGains"), slider.channels),
        (("shapes", "shapeGains"), slider.shapes),
    ):
        for i, field in enumerate(fields):
            put_value(prim, prefix + field, [row[i] for row in rows] if rows else None)
    put_value(prim, f"{prefix}mirror", slider.mirror)
    _author_curves(prim, prefix, slider)


def _author_curves(prim: Usd.Prim, prefix: str, slider: Slider) -> None:
    lists = (("channelKnots", slider.channel_curves), ("shapeKnots", slider.shape_curves))
    knots = [knot for _, curves in lists for curve in curves for knot in curve or ()]
    for field, curves in lists:
        counts = [len(curve or ()) for curve in curves]
        put_value(prim, prefix + field, counts if any(counts) else None)
    for i, field in enumerate(("knotValues", "knotAmounts")):
        put_value(prim, prefix + field, [knot[i] for knot in knots] or None)


def author_recipe(prim: Usd.Prim, recipe: Recipe) -> None:
    """Write the recipe on the face prim."""
    apply_schema(prim, tokens.RECIPE_API)
    put_value(prim, tokens.RECIPE_VERB, recipe.verb)
    put_value(prim, tokens.RECIPE_SOURCES, list(recipe.sources))
    put_value(prim, tokens.RECIPE_DIGESTS, list(recipe.digests))
    put_value(prim, tokens.RECIPE_OPTIONS, json.dumps(dict(recipe.options), sort_keys=True))
    put_value(prim, tokens.RECIPE_VERSION, recipe.version)
