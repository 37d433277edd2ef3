"""A raw look at a stage: values as they are authored, however wrong, so that every check sees its own defect."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdSkel

from facepipe.core import tokens
from facepipe.core.arrays import FloatArray
from facepipe.stage.composition import check_arrays
from facepipe.stage.prims import Known, check_kinds, inherited_attribute, inherited_skeleton, is_applied, prims_below
from facepipe.stage.values import UNREADABLE


class Problem(NamedTuple):
    """A defect: the path of the prim or property that has it, and one line that says what was found and expected."""

    path: str
    message: str


def at(culprit: Usd.Prim | Usd.Property | str, message: str) -> Problem:
    """The problem of a prim, property or path."""
    return Problem(culprit if isinstance(culprit, str) else str(culprit.GetPath()), message)


def some(values: Iterable[Any], limit: int = 5) -> str:
    """A few of `values`, and how many there are in all."""
    listed = [str(value) for value in values]
    return ", ".join(listed[:limit]) + (f" ... ({len(listed)} in all)" if len(listed) > limit else "")


def outside(culprit: Usd.Prim | Usd.Property | str, values: FloatArray | None, count: int) -> Iterator[Problem]:
    """The problem of indices, if there are any, that are not all in 0..count-1."""
    wrong = () if values is None else values[(values < 0) | (values >= count) | (values != np.floor(values))]
    if len(wrong):
        expected = f"0 to {count - 1}" if count else "none, since there is nothing to index"
        yield at(culprit, f"index {some(f'{one:g}' for one in np.unique(wrong))} out of range, expected {expected}")


def unlisted(where: str, field: str, names: Iterable[str], known: Collection[str]) -> Iterator[Problem]:
    """The problem of a field's names that the face does not have."""
    unknown = sorted(set(names) - set(known))
    if unknown:
        yield at(f"{where}:{field}", f"{some(unknown)}: unknown, expected {field} of the face")


def value(attribute: Usd.Attribute | None, time: Usd.TimeCode | None = None) -> Any:
    """The value at `time`; None: the default value, or the first time sample where there is none."""
    if not attribute:
        return None
    try:
        if time is not None:
            return attribute.Get(time)
        found = attribute.Get()
        return attribute.Get(Usd.TimeCode.EarliestTime()) if found is None else found
    except (*UNREADABLE, RuntimeError):
        return None  # the check of readable values reports it


def array(value: Any, *shape: int) -> FloatArray | None:
    """A value as (n, *shape) float64; None where it is missing or no such numbers."""
    if value is None or isinstance(value, str | bytes):
        return None
    try:
        return np.array(value, dtype=np.float64).reshape(-1, *shape)
    except (TypeError, ValueError, OverflowError):
        return None


def numbers(attribute: Usd.Attribute | None, *shape: int) -> FloatArray | None:
    """An attribute as (n, *shape) float64; None where it is missing or holds no such numbers."""
    return array(value(attribute), *shape)


def length(values: FloatArray | None) -> int:
    """How many values or rows there are; 0 where they are missing."""
    return 0 if values is None else len(values)


def words(attribute: Usd.Attribute | None) -> tuple[str, ...]:
    """An array of tokens or strings; empty where it is missing or something else."""
    found = value(attribute)
    return tuple(str(word) for word in found) if hasattr(found, "__iter__") and not isinstance(found, str) else ()


def times(attributes: list[Usd.Attribute]) -> list[Usd.TimeCode]:
    """Every time with a sample; the default time where there is none."""
    codes = sorted({code for attribute in attributes if attribute for code in attribute.GetTimeSamples()})
    return [Usd.TimeCode(code) for code in codes] or [Usd.TimeCode.Default()]


class MeshView:
    """A Mesh prim and the skel properties that hold for it, its own or those of a prim above."""

    def __init__(self, prim: Usd.Prim, known: Known) -> None:
        """:param known: what holds for the prims above, shared by all meshes"""
        self.prim = prim
        self.path = str(prim.GetPath())
        self._known = known
        self.mesh = UsdGeom.Mesh(prim)

    @cached_property
    def count(self) -> int:
        """Number of points."""
        return length(numbers(self.mesh.GetPointsAttr(), 3))

    @cached_property
    def corners(self) -> int:
        """Number of face-vertex indices."""
        return length(numbers(self.mesh.GetFaceVertexIndicesAttr()))

    def inherited(self, name: str) -> Usd.Attribute | None:
        """An attribute with a value, of the mesh or the nearest prim above that has one."""
        return inherited_attribute(self.prim, name, self._known)

    @cached_property
    def skeleton_path(self) -> Sdf.Path | None:
        """What skel:skeleton of the mesh or a prim above names."""
        return inherited_skeleton(self.prim, self._known)

    @cached_property
    def joint_indices(self) -> FloatArray | None:
        """(entries,) joint indices."""
        return numbers(self.inherited("primvars:skel:jointIndices"))

    @cached_property
    def joint_weights(self) -> FloatArray | None:
        """(entries,) joint weights."""
        return numbers(self.inherited("primvars:skel:jointWeights"))

    @property
    def is_skinned(self) -> bool:
        """Whether joint influences are authored."""
        return self.joint_indices is not None or self.joint_weights is not None

    @cached_property
    def shape_names(self) -> tuple[str, ...]:
        """skel:blendShapes."""
        return words(self.prim.GetAttribute("skel:blendShapes"))

    @cached_property
    def shape_targets(self) -> list[Sdf.Path]:
        """skel:blendShapeTargets."""
        relationship = self.prim.GetRelationship("skel:blendShapeTargets")
        return list(relationship.GetForwardedTargets()) if relationship else []

    @cached_property
    def shapes(self) -> list[UsdSkel.BlendShape]:
        """The BlendShape prims of the targets that are there."""
        prims = [self.prim.GetStage().GetPrimAtPath(target) for target in self.shape_targets if target.IsPrimPath()]
        return [UsdSkel.BlendShape(prim) for prim in prims if prim and prim.IsA(UsdSkel.BlendShape)]


class SkeletonView:
    """A Skeleton prim."""

    def __init__(self, prim: Usd.Prim) -> None:
        self.prim = prim
        self.path = str(prim.GetPath())
        skeleton = UsdSkel.Skeleton(prim)
        self.joints = words(skeleton.GetJointsAttr())
        self.bind = numbers(skeleton.GetBindTransformsAttr(), 4, 4)  # row vectors, as USD has them
        self.rest = numbers(skeleton.GetRestTransformsAttr(), 4, 4)


class FaceView:
    """The face of a stage, or all of the stage where it has none."""

    def __init__(self, stage: Usd.Stage) -> None:
        """:raises InputError: more prims than a face can have"""
        self.stage = stage
        where = stage.GetRootLayer().realPath or stage.GetRootLayer().identifier
        everything = list(prims_below(stage.GetPseudoRoot(), where))
        found = [prim for prim in everything if is_applied(prim, tokens.FACE_API)]
        default = stage.GetDefaultPrim()
        self.prim: Usd.Prim | None = default if default in found else next(iter(found), None)
        self.prims = list(prims_below(self.prim, where)) if self.prim else everything[1:]
        check_kinds(self.prims, where)
        check_arrays(self.prims, where)

    def of_type(self, schema: Any) -> Iterator[Usd.Prim]:
        """Prims of a schema class, in stage order."""
        return (prim for prim in self.prims if prim.IsA(schema))

    @cached_property
    def meshes(self) -> list[MeshView]:
        """Its meshes."""
        known: Known = {}
        return [MeshView(prim, known) for prim in self.of_type(UsdGeom.Mesh)]

    @cached_property
    def skeletons(self) -> list[SkeletonView]:
        """Its skeletons; the convention asks for one."""
        return [SkeletonView(prim) for prim in self.of_type(UsdSkel.Skeleton)]

    @cached_property
    def animations(self) -> list[UsdSkel.Animation]:
        """Its poses and clips."""
        return [UsdSkel.Animation(prim) for prim in self.of_type(UsdSkel.Animation)]

    @cached_property
    def joints(self) -> tuple[str, ...]:
        """The joints of its first skeleton."""
        return self.skeletons[0].joints if self.skeletons else ()

    @cached_property
    def shape_names(self) -> set[str]:
        """Names of all blendshapes."""
        return {name for mesh in self.meshes for name in mesh.shape_names}

    def joints_of(self, mesh: MeshView) -> tuple[str, ...]:
        """What joint indices of a mesh count: its skel:joints, or the joints of the skeleton bound to it."""
        own = words(mesh.inherited("skel:joints"))
        if own:
            return own
        bound = [skeleton.joints for skeleton in self.skeletons if skeleton.prim.GetPath() == mesh.skeleton_path]
        return bound[0] if bound else self.joints
