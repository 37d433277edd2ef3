"""Checks of skeletons, their limits and their animations."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import numpy as np
from pxr import Sdf

from facepipe.checks.deformation_checks import is_singular
from facepipe.checks.views import FaceView, Problem, SkeletonView, array, at, length, numbers, some, times, value, words
from facepipe.core import tokens
from facepipe.core.arrays import FloatArray

_Transforms = tuple[tuple[str, FloatArray | None], ...]


def _transforms(skeleton: SkeletonView) -> _Transforms:
    return (("bindTransforms", skeleton.bind), ("restTransforms", skeleton.rest))


def transform_count(face: FaceView) -> Iterator[Problem]:
    """As many bind and rest transforms as joints."""
    for skeleton in face.skeletons:
        for name, matrices in _transforms(skeleton):
            if length(matrices) != len(skeleton.joints):
                found = f"{length(matrices)} transforms"
                yield at(f"{skeleton.path}.{name}", f"{found}, expected {len(skeleton.joints)}")


def joint_order(face: FaceView) -> Iterator[Problem]:
    """Joints stand parent first."""
    for skeleton in face.skeletons:
        place = {joint: i for i, joint in reversed(list(enumerate(skeleton.joints)))}
        late = [
            joint
            for i, joint in enumerate(skeleton.joints)
            if any(place.get(above, -1) > i for above in _ancestors(joint))
        ]
        if late:
            yield at(f"{skeleton.path}.joints", f"{some(late)} before a parent, expected parents first")


def joint_names(face: FaceView) -> Iterator[Problem]:
    """Joint names are valid paths, each once."""
    for skeleton in face.skeletons:
        twice = sorted(joint for joint, count in Counter(skeleton.joints).items() if count > 1)
        if twice:
            yield at(f"{skeleton.path}.joints", f"{some(twice)} twice, expected each joint once")
        wrong = [joint for joint in skeleton.joints if not _is_path(joint)]
        if wrong:
            yield at(f"{skeleton.path}.joints", f"{some(map(repr, wrong))}: no path, expected names joined by /")


def _is_path(joint: str) -> bool:
    return bool(joint) and all(Sdf.Path.IsValidIdentifier(name) for name in joint.removeprefix("/").split("/"))


def _ancestors(joint: str) -> Iterator[str]:
    above = joint.rpartition("/")[0]
    while above:
        yield above
        above = above.rpartition("/")[0]


def transforms_invertible(face: FaceView) -> Iterator[Problem]:
    """Bind transforms are invertible."""
    for skeleton in face.skeletons:
        singular = [] if skeleton.bind is None else np.flatnonzero(is_singular(skeleton.bind)).tolist()
        if singular:
            names = some(_name(skeleton.joints, i) for i in singular)
            yield at(f"{skeleton.path}.bindTransforms", f"singular matrix of {names}, expected invertible ones")


def transforms_affine(face: FaceView) -> Iterator[Problem]:
    """The last column of bind and rest transforms (USD rows) is 0 0 0 1: no projection."""
    for skeleton in face.skeletons:
        for name, matrices in _transforms(skeleton):
            if matrices is None or not np.isfinite(matrices).all():
                continue
            wrong = np.flatnonzero(np.abs(matrices[:, :, 3] - (0, 0, 0, 1)).max(axis=1, initial=0) > 1e-6)
            if len(wrong):
                names = some(_name(skeleton.joints, i) for i in wrong.tolist())
                yield at(f"{skeleton.path}.{name}", f"no affine matrix for {names}, expected a last column 0 0 0 1")


def joint_scale(face: FaceView) -> Iterator[Problem]:
    """No joint is mirrored or scaled by a negative factor, at bind, at rest or in an animation."""
    for skeleton in face.skeletons:
        for name, matrices in _transforms(skeleton):
            if matrices is not None and np.isfinite(matrices).all():
                mirrored = np.flatnonzero(np.linalg.det(matrices[:, :3, :3]) < 0)
                if len(mirrored):
                    names = some(_name(skeleton.joints, i) for i in mirrored.tolist())
                    yield at(f"{skeleton.path}.{name}", f"mirrored matrix of {names}, expected positive scales")
    for animation in face.animations:
        joints, scales = words(animation.GetJointsAttr()), animation.GetScalesAttr()
        for time in times([scales]):
            values = array(value(scales, time), 3)
            if values is not None and (values < 0).any():
                names = some(_name(joints, i) for i in np.flatnonzero((values < 0).any(axis=1)).tolist())
                yield at(scales, f"negative scale of {names}, expected positive scales")
                break


def _name(joints: tuple[str, ...], i: int) -> str:
    return f"'{joints[i]}'" if i < len(joints) else f"number {i}"


def limits(face: FaceView) -> Iterator[Problem]:
    """Bone limits are 9 per joint, the lower at most the upper."""
    for skeleton in face.skeletons:
        lower, upper = (numbers(skeleton.prim.GetAttribute(n)) for n in (tokens.LIMITS_LOWER, tokens.LIMITS_UPPER))
        expected = 9 * len(skeleton.joints)
        counts = {tokens.LIMITS_LOWER: length(lower), tokens.LIMITS_UPPER: length(upper)}
        if set(counts.values()) in ({0}, {expected}):
            if lower is not None and upper is not None and (lower > upper).any():
                worst = int(np.argmax(lower > upper))
                found = f"value {worst}: lower limit {lower[worst]:g} above upper {upper[worst]:g}"
                yield at(f"{skeleton.path}.{tokens.LIMITS_LOWER}", f"{found}, expected at most that")
            continue
        for name, count in counts.items():
            if count != expected:
                yield at(f"{skeleton.path}.{name}", f"{count} values, expected {expected}")


def animation_count(face: FaceView) -> Iterator[Problem]:
    """Arrays of an animation have one entry per joint or blendshape of it, at every time."""
    for animation in face.animations:
        joints, shapes = len(words(animation.GetJointsAttr())), len(words(animation.GetBlendShapesAttr()))
        for attribute, width, expected in (
            (animation.GetTranslationsAttr(), 3, joints),
            (animation.GetRotationsAttr(), 4, joints),
            (animation.GetScalesAttr(), 3, joints),
            (animation.GetPrim().GetAttribute(tokens.BONE_COEFFICIENTS), 1, 9 * joints),
            (animation.GetBlendShapeWeightsAttr(), 1, shapes),
        ):
            if not attribute or not attribute.HasAuthoredValue():
                continue
            for time in times([attribute]):
                values = array(value(attribute, time), width)
                if values is not None and len(values) != expected:
                    when = "" if time.IsDefault() else f" at time {time.GetValue():g}"
                    yield at(attribute, f"{len(values)} values{when}, expected {expected}")
                    break


def animation_transforms(face: FaceView) -> Iterator[Problem]:
    """An animation with joints authors translations, rotations and scales: UsdSkel takes no joint pose without all."""
    for animation in face.animations:
        if not words(animation.GetJointsAttr()):
            continue
        for name in ("translations", "rotations", "scales"):
            attribute = animation.GetPrim().GetAttribute(name)
            if not attribute or not attribute.HasAuthoredValue():
                yield at(animation.GetPrim(), f"{name} not authored, expected one per joint")


def animation_names(face: FaceView) -> Iterator[Problem]:
    """Animations move joints and blendshapes that the face has, each once."""
    for animation in face.animations:
        for attribute, known, kind in (
            (animation.GetJointsAttr(), set(face.joints), "joint of the skeleton"),
            (animation.GetBlendShapesAttr(), face.shape_names, "blendshape of a mesh"),
        ):
            names = words(attribute)
            unknown = sorted(set(names) - known)
            if unknown:
                yield at(attribute, f"{some(unknown)}: no {kind}, expected one")
            if len(set(names)) != len(names):
                yield at(attribute, "a name twice, expected each once")


def rotations_unit(face: FaceView) -> Iterator[Problem]:
    """Rotations of animations are unit quaternions."""
    for animation in face.animations:
        attribute = animation.GetRotationsAttr()
        for time in times([attribute]):
            values = array(value(attribute, time), 4)
            sizes = np.linalg.norm(values, axis=1) if values is not None and np.isfinite(values).all() else np.ones(1)
            if (np.abs(sizes - 1) > 1e-3).any():
                worst = float(sizes[np.argmax(np.abs(sizes - 1))])
                yield at(attribute, f"quaternion of length {worst:g}, expected 1")
                break
