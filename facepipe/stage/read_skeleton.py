"""Skeleton, animations, limits, sliders and recipe of a stage as parts."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import numpy.typing as npt
from pxr import Usd, UsdGeom, UsdSkel

from facepipe import tokens
from facepipe.errors import SchemaError, TopologyError
from facepipe.parts import Animation, BoneLimits, Recipe, Skeleton, Slider
from facepipe.stage.guard import reads_prim
from facepipe.stage.values import floats, matrices, matrix, quaternions

FloatArray = npt.NDArray[np.floating]


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
    world = matrix(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(Usd.TimeCode.Default()))
    result = Skeleton(name=prim.GetName(), joints=joints, bind_transforms=bind, rest_transforms=rest, transform=world)
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
def read_animation(prim: Usd.Prim) -> Animation:
    """A SkelAnimation prim: its time samples, or its default values as one pose.

    :raises TopologyError: arrays that don't fit the joints or shapes
    """
    animation = UsdSkel.Animation(prim)
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
    codes = sorted({code for attribute in attributes for code in attribute.GetTimeSamples()})
    times = [Usd.TimeCode(code) for code in codes] or [Usd.TimeCode.Default()]
    rate = prim.GetStage().GetTimeCodesPerSecond() or 24.0

    def samples(attribute: Usd.Attribute, count: int, width: int, quaternion: bool = False) -> FloatArray | None:
        if not attribute or not attribute.HasAuthoredValue():
            return None
        read = [attribute.Get(time) for time in times]
        rows = [quaternions(one) if quaternion else floats(one, width) for one in read]
        other = next((len(row) for row in rows if len(row) != count), None)
        if other is not None:
            raise TopologyError(attribute.GetPath(), f"{other} values at a time sample, expected {count}")
        return np.stack(rows) if count else None

    weights = samples(attributes[3], len(shapes), 1)
    return Animation(
        name=prim.GetName(),
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
def read_sliders(prim: Usd.Prim) -> tuple[Slider, ...]:
    """The sliders applied to the face prim, by name.

    :raises SchemaError: lists of one slider that are not parallel, or a range that is none
    """
    names = {
        one.GetName().removeprefix(tokens.SLIDER_PREFIX).rpartition(":")[0]
        for one in prim.GetAuthoredPropertiesInNamespace(tokens.SLIDER_PREFIX.rstrip(":"))
        if isinstance(one, Usd.Attribute) and one.HasAuthoredValue()  # an override layer blocks sliders that are gone
    }
    return tuple(_slider(prim, name) for name in sorted(names))


def _slider(prim: Usd.Prim, name: str) -> Slider:
    def value(field: str) -> Any:
        return prim.GetAttribute(f"{tokens.SLIDER_PREFIX}{name}:{field}").Get()

    def number(field: str, otherwise: float) -> float:
        found = value(field)
        return otherwise if found is None else float(found)

    def words(field: str) -> list[str]:
        return [str(word) for word in value(field) or []]

    joints, channels, gains = words("joints"), words("channels"), floats(value("channelGains")).tolist()
    shapes, shape_gains = words("shapes"), floats(value("shapeGains")).tolist()
    where = f"{prim.GetPath()}.{tokens.SLIDER_PREFIX}{name}"
    if not len(joints) == len(channels) == len(gains) or len(shapes) != len(shape_gains):
        raise SchemaError(where, "joints, channels and gains (or shapes and gains) of different lengths")
    slider = Slider(
        name=name,
        group=str(value("group") or ""),
        default=number("default", 0.0),
        minimum=number("minimum", 0.0),
        maximum=number("maximum", 1.0),
        value=None if value("value") is None else number("value", 0.0),
        channels=tuple(zip(joints, channels, gains, strict=True)),
        shapes=tuple(zip(shapes, shape_gains, strict=True)),
    )
    if not slider.minimum <= slider.default <= slider.maximum:
        raise SchemaError(where, f"default {slider.default}, expected {slider.minimum} to {slider.maximum}")
    return slider


@reads_prim
def read_recipe(prim: Usd.Prim) -> Recipe | None:
    """The recipe of the face prim, where it has one."""
    verb = prim.GetAttribute(tokens.RECIPE_VERB).Get()
    if not verb:
        return None
    text = prim.GetAttribute(tokens.RECIPE_OPTIONS).Get() or "{}"
    try:
        options = json.loads(text)
    except (ValueError, RecursionError):
        raise SchemaError(f"{prim.GetPath()}.{tokens.RECIPE_OPTIONS}", "no JSON, expected a JSON object") from None
    return Recipe(
        verb=str(verb),
        sources=tuple(prim.GetAttribute(tokens.RECIPE_SOURCES).Get() or ()),
        digests=tuple(prim.GetAttribute(tokens.RECIPE_DIGESTS).Get() or ()),
        options=options,
        version=str(prim.GetAttribute(tokens.RECIPE_VERSION).Get() or ""),
    )
