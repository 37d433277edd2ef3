"""What of a skeleton, its limits, sliders and texts of the face differs, authored over the prims."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from pxr import Sdf, Usd, UsdSkel

from facepipe.core import tokens
from facepipe.core.errors import InputError, TopologyError
from facepipe.parts import BoneLimits, FaceParts, Recipe, Skeleton, Slider
from facepipe.stage.api_schemas import put, put_value, remove_schema
from facepipe.stage.author_skeleton import author_limits, author_recipe, author_sliders
from facepipe.stage.differences import same
from facepipe.stage.opinions import editable
from facepipe.stage.values import to_matrices


def check_skeleton_change(where: str, old: Skeleton, new: Skeleton) -> None:
    """Check that what differs can be authored over a skeleton: joints for one without, with their transforms.

    :raises TopologyError: other joints than it has, or not one bind and rest transform each
    :raises InputError: joint paths that are not parent first, or another name or place of the skeleton
    """
    where = f"{where} -> {old.name}"
    if old.joints and old.joints != new.joints:
        raise TopologyError(where, "other joints, expected those of the face")
    for name, transforms in (("bind", new.bind_transforms), ("rest", new.rest_transforms)):
        if np.shape(transforms) != (len(new.joints), 4, 4):
            raise TopologyError(where, f"{name} transforms {np.shape(transforms)}, expected one (4, 4) per joint")
    if not old.joints and new.joints:
        _check_joints(where, new.joints)
    for field in ("name", "transform"):
        if not same(getattr(old, field), getattr(new, field)):
            raise InputError(f"{where} -> {field}", "differs, expected as on the face")


def _check_joints(where: str, joints: Sequence[str]) -> None:
    topology = UsdSkel.Topology(list(joints))
    valid, reason = topology.Validate()
    if not valid or len(set(joints)) != len(joints) or not all(map(Sdf.Path.IsValidPathString, joints)):
        raise InputError(where, f"joints that no skeleton can have, expected different paths, parents first {reason}")


def author_skeleton_changes(prim: Usd.Prim, old: Skeleton, new: Skeleton) -> tuple[str, ...]:
    """Author on a Skeleton prim the joints, bind and rest transforms that differ; the names of these."""
    added: tuple[str, ...] = ()
    if old.joints != new.joints:
        put(UsdSkel.Skeleton(editable(prim)).CreateJointsAttr(), list(new.joints))
        added = (f"{new.name}: {len(new.joints)} joints",)
    if old.names != new.names:
        skeleton = UsdSkel.Skeleton(editable(prim))
        names = skeleton.CreateJointNamesAttr() if new.joint_names else skeleton.GetJointNamesAttr()
        put(names, list(new.joint_names) or None)
        added = added or (f"{new.name}: names of joints",)
    pairs = {
        "bindTransforms": (old.bind_transforms, new.bind_transforms),
        "restTransforms": (old.rest_transforms, new.rest_transforms),
    }
    changed = {name: there for name, (before, there) in pairs.items() if not same(before, there)}
    for name, transforms in changed.items():
        put(editable(prim).GetAttribute(name), to_matrices(transforms))
    return (*added, *(f"{new.name}: {name}" for name in changed))


def author_limit_changes(prim: Usd.Prim, old: BoneLimits | None, new: BoneLimits | None) -> tuple[str, ...]:
    """Author on a Skeleton prim its bone limits where they differ; a line then."""
    if same(old, new):
        return ()
    prim = editable(prim)
    if new is not None:
        author_limits(prim, new)
    else:
        for name in (tokens.LIMITS_LOWER, tokens.LIMITS_UPPER):
            put_value(prim, name, None)
        remove_schema(prim, tokens.BONE_LIMITS_API)
    return ("bone limits",)


def author_slider_changes(prim: Usd.Prim, old: Sequence[Slider], new: Sequence[Slider]) -> tuple[str, ...]:
    """Author on the face prim the sliders that differ, and hide those that are gone; a line for each."""
    before, after = ({slider.name: slider for slider in sliders} for sliders in (old, new))
    changed = [slider for slider in new if not same(slider, before.get(slider.name))]
    anew = []
    for slider in changed:
        own = before.get(slider.name)
        if own is not None and same(replace(slider, value=own.value), own):
            put_value(prim, f"{tokens.SLIDER_PREFIX}{slider.name}:value", slider.value)
        else:
            anew.append(slider)
    author_sliders(prim, anew)
    removed = [name for name in before if name not in after]
    for name in removed:
        for attribute in prim.GetAuthoredPropertiesInNamespace(f"{tokens.SLIDER_PREFIX}{name}"):
            if attribute.GetName().rpartition(":")[0] == f"{tokens.SLIDER_PREFIX}{name}":
                put(attribute, None)
        remove_schema(prim, tokens.SLIDER_API, name)
    return tuple(f"slider {name}" for name in (*(slider.name for slider in changed), *removed))


def author_text_changes(prim: Usd.Prim, old: FaceParts, new: FaceParts) -> tuple[str, ...]:
    """Author on the face prim attribution, attach joint, person and recipe where they differ; a line for each."""
    lines = []
    for name, line, before, after in (
        (tokens.ATTRIBUTION, "attribution", old.attribution, new.attribution),
        (tokens.ATTACH_JOINT, "attach joint", old.attach_joint or "", new.attach_joint or ""),
        (tokens.PERSON, "person", old.person or "", new.person or ""),
    ):
        if before != after:
            put_value(prim, name, after)
            lines.append(line)
    if _content(old.recipe) != _content(new.recipe):
        if new.recipe is not None:
            author_recipe(prim, new.recipe)
        else:
            for attribute in prim.GetAuthoredPropertiesInNamespace(tokens.RECIPE_VERB.rpartition(":")[0]):
                put(attribute, None)
            remove_schema(prim, tokens.RECIPE_API)
        lines.append("recipe")
    return tuple(lines)


def _content(recipe: Recipe | None) -> tuple[object, ...] | None:
    if recipe is None:
        return None
    options = json.dumps(dict(recipe.options), sort_keys=True)
    return recipe.verb, tuple(recipe.sources), tuple(recipe.digests), options, recipe.version
