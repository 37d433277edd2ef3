"""Skeleton, animations, bone limits and recipe of a face: read as parts; all but animations authored from them."""

from __future__ import annotations

import json

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdSkel

from facepipe.core import tokens
from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError, SchemaError, TopologyError
from facepipe.core.reading import check_values
from facepipe.parts import Animation, BoneLimits, Recipe, Skeleton
from facepipe.stage.api_schemas import apply_schema, put_value
from facepipe.stage.guard import reads_prim
from facepipe.stage.prims import exact_name, label
from facepipe.stage.values import floats, matrices, matrix, quaternions, to_floats, to_matrices, to_matrix


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
        joint_names=names if names != Skeleton(joints=joints).names else (),  # the last parts of the paths need none
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
