"""Puts a performance on a face: weights on its shapes, turns on its joints."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from facepipe.errors import InputError
from facepipe.names import did_you_mean
from facepipe.parts import Animation, FaceParts, FloatArray, Recipe
from facepipe.processors.animate.angles import PARTS, angle_of
from facepipe.processors.animate.options import AnimateOptions
from facepipe.processors.animate.performance import Performance
from facepipe.processors.animate.turned_joints import angles_of, joint_of, turned_by_shapes, turns
from facepipe.reports import Report
from facepipe.rig.conventions import match_shapes
from facepipe.stage import Face
from facepipe.stage.animation_source import on_frames, play
from facepipe.stage.author_changes import author_changes


@dataclass(frozen=True, kw_only=True)
class AnimateReport(Report):
    """What was authored, and what of the performance was not."""

    animation: str
    frames: int
    frames_per_second: float
    start: float  # seconds on the stage
    end: float
    shapes: tuple[str, ...]
    joints: Mapping[str, str] = field(default_factory=dict)  # Head, LeftEye, RightEye -> path of the joint that turns
    renamed: Mapping[str, str] = field(default_factory=dict)  # name in the performance -> shapes, where they differ
    no_target: Mapping[str, str] = field(default_factory=dict)  # name in the performance -> why it moves nothing
    filled: int = 0  # frames that the performance lacks
    authored: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class AnimateFace:
    """A performance as a SkelAnimation that the face's skeleton plays.

    Frames that are missing lie straight between those around them. Of `options` what says how the file is read is the
    reader's business.

    :param name: of the animation
    """

    performance: Performance
    name: str
    options: AnimateOptions = field(default_factory=AnimateOptions)

    def __call__(self, face: Face, *, recipe: Recipe | None = None) -> AnimateReport:
        """Author it.

        :param recipe: authored with the result; None leaves what the face has
        :raises InputError: nothing of the performance has a target, two of its names have the same, no such joint, no
            frame is left, or the animation's name is taken
        """
        parts = face.parts()
        if any(one.name == self.name for one in parts.animations):
            raise InputError(face.where, f"has an animation '{self.name}' already, expected another name")
        performance = self.performance.cut(self.options.start, self.options.end)
        performance = performance.at_rate(self.options.resample or performance.fps)
        weights, renamed, no_target = _weights(parts, performance)
        joints, coefficients, unturned = _turned(face.where, parts, performance, self.options, tuple(weights))
        if not weights and not joints:
            raise InputError(face.where, _another_face(performance, parts))
        times = on_frames(face, performance.seconds + self.options.offset)
        animation = Animation(
            name=self.name,
            times=times,
            joints=tuple(joints.values()),
            coefficients=coefficients,
            shapes=tuple(weights),
            shape_weights=np.stack(list(weights.values()), axis=1) if weights else None,
        )
        changed = replace(parts, animations=(*parts.animations, animation), recipe=recipe or parts.recipe)
        authored = author_changes(face, changed)
        play(face, self.name)
        return AnimateReport(
            animation=self.name,
            frames=len(times),
            frames_per_second=performance.fps,
            start=float(times[0]),
            end=float(times[-1]),
            shapes=tuple(weights),
            joints=joints,
            renamed=renamed,
            no_target={**no_target, **unturned},
            filled=performance.filled,
            authored=authored,
            warnings=performance.warnings,
        )


def _weights(
    parts: FaceParts, performance: Performance
) -> tuple[dict[str, FloatArray], dict[str, str], dict[str, str]]:
    """Shape -> (T,) weights; name -> shapes that are called otherwise; name -> why it has no target."""
    shapes = _shapes(parts)
    columns = dict(zip(performance.names, performance.values.T, strict=True))
    names = [name for name in performance.names if not angle_of(name)]
    found = match_shapes(names, shapes)
    weights = {target: columns[name] for name, targets in found.items() for target in targets}
    renamed = {name: ", ".join(targets) for name, targets in found.items() if targets != (name,)}
    left = [shape for shape in shapes if shape not in weights]
    lost = {name: f"no such shape{did_you_mean(name, left)}" for name in names if name not in found}
    return weights, renamed, lost


def _turned(
    where: str, parts: FaceParts, performance: Performance, options: AnimateOptions, shapes: tuple[str, ...]
) -> tuple[dict[str, str], FloatArray | None, dict[str, str]]:
    """Part -> joint, (T, joints, 9) coefficients, and the angles without target with why."""
    joints: dict[str, str] = {}
    moved: list[FloatArray] = []
    lost: dict[str, str] = {}
    wanted = dict(zip(PARTS, (options.head, options.left_eye, options.right_eye), strict=True))
    for part in PARTS:
        joint = joint_of(where, parts.skeleton, part, wanted[part])
        angles = angles_of(performance, part)
        why = "left out" if wanted[part] else "no such joint"
        if joint is not None and wanted[part] is None and part != "Head":
            by = turned_by_shapes(parts.meshes, joint, part.removesuffix("Eye").lower(), shapes)
            joint, why = (joint, "") if by is None else (None, f"{by} and its like turn this eye")
        if not angles.any():
            continue
        if joint is None:
            lost |= {name: why for name in performance.names if (angle_of(name) or "").startswith(part)}
            continue
        joints[part] = parts.skeleton.joints[joint]
        moved.append(turns(parts.skeleton, parts.up_axis, joint, angles))
    if len(set(joints.values())) < len(joints):
        raise InputError(where, f"one joint for two of {', '.join(joints)}, expected different ones")
    return joints, np.stack(moved, axis=1) if moved else None, lost


def _shapes(parts: FaceParts) -> list[str]:
    return list(dict.fromkeys(shape.name for mesh in parts.meshes for shape in mesh.blendshapes))


def _another_face(performance: Performance, parts: FaceParts) -> str:
    shapes, first = _shapes(parts), performance.names[0]
    some = ", ".join(shapes[:4]) + (" ..." if len(shapes) > 4 else "") or "none, there are none"
    names = f"{len(performance.names)} names ('{first[:40]}' ...) of {Path(performance.where).name}"
    return f"none of its shapes is among the {names}, expected some of {some}{did_you_mean(first, shapes)}"
