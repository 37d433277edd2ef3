"""Vertex groups of a mesh: bones, regions, or helpers of modifiers and shape keys."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import FacepipeError
from facepipe.hosting.host_face import check_region_name
from facepipe.parts import Skin

REGION = "region:"  # before the name of a region, since bones are called `chin` too
SUBSET = "subset:"  # before the name of a point subset, of boolean point attributes


class Groups(NamedTuple):
    """Weights (n,) of a mesh's vertex groups by what they are for."""

    bones: dict[str, FloatArray]
    regions: dict[str, FloatArray]
    others: tuple[str, ...]  # groups that name no region


def read_groups(obj: Any, bones: set[str], helpers: set[str]) -> Groups:
    """The vertex groups of a mesh object.

    :param helpers: names of those that serve modifiers and shape keys

    Groups called ``region:NAME`` are its regions; where there are none, all groups with weights that are no bones and
    serve no modifier or shape key.
    """
    count = len(obj.data.vertices)
    weights = [np.zeros(count) for _ in obj.vertex_groups]
    for index, vertex in enumerate(obj.data.vertices):
        for entry in vertex.groups:
            if entry.group < len(weights):
                weights[entry.group][index] = entry.weight
    weights = {group.name: values for group, values in zip(obj.vertex_groups, weights, strict=True)}
    of_bones = {name: values for name, values in weights.items() if name in bones}
    free = {name: values for name, values in weights.items() if name not in bones}
    marked = {name: values for name, values in free.items() if name.startswith(REGION)}
    chosen = marked or {name: values for name, values in free.items() if name not in helpers}
    regions = {name.removeprefix(REGION): values for name, values in chosen.items() if _names_region(name, values)}
    others = [name for name in free if name.removeprefix(REGION) not in regions and name not in helpers]
    return Groups(of_bones, regions, tuple(others))


def write_regions(obj: Any, regions: dict[str, FloatArray]) -> None:
    """The regions as vertex groups of a mesh object, in place of those it has."""
    _remove(obj, [group.name for group in obj.vertex_groups if group.name.startswith(REGION)])
    _add(obj, {REGION + name: mask for name, mask in regions.items()})


def write_skin(obj: Any, skin: Skin, bones: Sequence[str]) -> None:
    """The weights of a skin as vertex groups of a mesh object, in place of those of its bones.

    :param bones: name of the bone of every joint
    """
    _remove(obj, [group.name for group in obj.vertex_groups if group.name in set(bones)])
    weights: dict[str, FloatArray] = {}
    for joint in np.unique(skin.joint_indices[skin.joint_weights != 0]).tolist():
        weights[bones[joint]] = np.where(skin.joint_indices == joint, skin.joint_weights, 0.0).sum(axis=1)
    _add(obj, weights)


def _remove(obj: Any, names: Sequence[str]) -> None:
    for name in names:
        obj.vertex_groups.remove(obj.vertex_groups[name])


def _add(obj: Any, groups: Mapping[str, FloatArray]) -> None:
    for name, mask in groups.items():
        group = obj.vertex_groups.new(name=name)
        values = np.asarray(mask, dtype=np.float64)
        for value in np.unique(values[values != 0]):
            group.add(np.flatnonzero(values == value).tolist(), float(value), "REPLACE")


def helper_groups(obj: Any) -> set[str]:
    """Names of the vertex groups that modifiers and shape keys use."""
    keys = obj.data.shape_keys.key_blocks if obj.data.shape_keys else ()
    return {str(getattr(one, "vertex_group", "")) for one in (*obj.modifiers, *keys)}


def _names_region(name: str, values: FloatArray) -> bool:
    try:
        check_region_name(name, name.removeprefix(REGION))
    except FacepipeError:
        return False
    return bool(values.any()) or name.startswith(REGION)
