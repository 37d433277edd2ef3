"""Puts a performance on a face: weights on its shapes, turns on its joints."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.names import did_you_mean, first_names
from facepipe.core.reports import Report
from facepipe.parts import Animation, FaceParts, Recipe, Skeleton
from facepipe.rig.bone_coefficients import rest_coefficients
from facepipe.rig.conventions import match_shapes, spelling
from facepipe.stage import Face
from facepipe.stage.animation_source import on_frames, play
from facepipe.stage.author_changes import author_changes
from facepipe.verbs.animate.options import AnimateOptions
from facepipe.verbs.animate.performance import PARTS, Performance, angle_of
from facepipe.verbs.animate.turned_joints import (
    angles_of,
    driven,
    joint_of,
    turned,
    turned_by_shapes,
    turned_by_sliders,
    turns,
)


@dataclass(frozen=True, kw_only=True)
class AnimateReport(Report):
    """What was authored, and what of the performance was not."""

    animation: str
    frames: int
    frames_per_second: float
    start: float  # seconds on the stage
    end: float
    shapes: tuple[str, ...]
    sliders: tuple[str, ...] = ()  # whose motion is in the clip
    joints: Mapping[str, str] = field(default_factory=dict)  # Head, LeftEye, RightEye -> path of the joint that turns
    renamed: Mapping[str, str] = field(
        default_factory=dict
    )  # name in the performance -> shapes or sliders, where they differ
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

    def __call__(
        self, face: Face, *, recipe: Recipe | None = None, done: Callable[[], object] = lambda: None
    ) -> AnimateReport:
        """Author it.

        :param recipe: authored with the result; None leaves what the face has
        :param done: called after every frame that sliders move
        :raises InputError: nothing of the performance has a target, no such joint or one for two parts, no frame is
            left, or the animation's name is taken
        """
        parts = face.parts()
        if any(one.name == self.name for one in parts.animations):
            raise InputError(face.where, f"has an animation '{self.name}' already, expected another name")
        performance = self.performance.cut(self.options.start, self.options.end)
        performance = performance.at_rate(self.options.resample or performance.fps)
        targets = _targets(parts, performance)
        joints, turns, unturned = _turned(face.where, parts, performance, self.options, targets)
        if not targets.weights and not targets.sliders and not joints:
            raise InputError(face.where, _another_face(performance, parts))
        by_sliders = driven(parts, targets.sliders, len(performance.values), done)
        weights = {**by_sliders.weights, **targets.weights}
        # sum_k b_k delta_k is linear: what sliders and the performance give one shape adds, neither replaces the other
        weights |= {
            one: by_sliders.weights[one] + targets.weights[one] for one in by_sliders.weights.keys() & targets.weights
        }
        moving, coefficients = _moved(parts.skeleton, by_sliders.coefficients, turns)
        times = on_frames(face, performance.seconds + self.options.offset)
        animation = Animation(
            name=self.name,
            times=times,
            joints=moving,
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
            shapes=tuple(targets.weights),
            sliders=tuple(targets.sliders),
            joints=joints,
            renamed=targets.renamed,
            no_target={**targets.lost, **unturned},
            filled=performance.filled,
            authored=authored,
            warnings=performance.warnings,
        )


class _Targets(NamedTuple):
    weights: dict[str, FloatArray]  # shape -> (T,)
    sliders: dict[str, FloatArray]  # slider -> (T,)
    renamed: dict[str, str]  # name -> shapes or sliders that are called otherwise
    lost: dict[str, str]  # name -> why it has no target


def _targets(parts: FaceParts, performance: Performance) -> _Targets:
    """Where weights go: to shapes, and to sliders that are not called as one of these."""
    shapes = parts.shapes
    taken = {spelling(shape) for shape in shapes}
    sliders = [slider.name for slider in parts.sliders if spelling(slider.name) not in taken]
    columns = dict(zip(performance.names, performance.values.T, strict=True))
    names = [name for name in performance.names if not angle_of(name)]
    matched = match_shapes(names, [*shapes, *sliders])
    column_of = {target: columns[name] for name, targets in matched.items() for target in targets}
    free = [one for one in (*shapes, *sliders) if one not in column_of]
    lacking = "no such shape or slider" if sliders else "no such shape"
    return _Targets(
        {target: column for target, column in column_of.items() if target in shapes},
        {target: column for target, column in column_of.items() if target in sliders},
        {name: ", ".join(targets) for name, targets in matched.items() if targets != (name,)},
        {name: f"{lacking}{did_you_mean(name, free)}" for name in names if name not in matched},
    )


def _turned(
    where: str, parts: FaceParts, performance: Performance, options: AnimateOptions, targets: _Targets
) -> tuple[dict[str, str], dict[int, FloatArray], dict[str, str]]:
    """Part -> joint, number of a joint -> (T, 9) coefficients, and the angles without target with why."""
    joints: dict[str, str] = {}
    turned_by: dict[int, FloatArray] = {}
    lost: dict[str, str] = {}
    wanted = dict(zip(PARTS, (options.head, options.left_eye, options.right_eye), strict=True))
    for part in PARTS:
        joint = joint_of(where, parts.skeleton, part, wanted[part])
        angles = angles_of(performance, part)
        why = "left out" if wanted[part] else "no such joint"
        # an eye that shapes or sliders turn already would turn twice by its joint as well
        if joint is not None and wanted[part] is None and part != "Head":
            by = turned_by_shapes(parts.meshes, joint, part.removesuffix("Eye"), targets.weights)
            by = by or turned_by_sliders(parts.sliders, parts.skeleton.joints[joint], targets.sliders)
            joint, why = (joint, "") if by is None else (None, f"{by} and its like turn this eye")
        if not angles.any():
            continue
        if joint is None:
            lost |= {name: why for name in performance.names if (angle_of(name) or "").startswith(part)}
            continue
        joints[part] = parts.skeleton.joints[joint]
        turned_by[joint] = turns(parts.skeleton, parts.up_axis, joint, angles)
    if len(set(joints.values())) < len(joints):
        raise InputError(where, f"one joint for two of {', '.join(joints)}, expected different ones")
    return joints, turned_by, lost


def _moved(
    skeleton: Skeleton, by_sliders: FloatArray, turns: Mapping[int, FloatArray]
) -> tuple[tuple[str, ...], FloatArray | None]:
    """The joints that leave rest, and their (T, joints, 9) coefficients."""
    coefficients = np.array(by_sliders)
    for joint, turn in turns.items():
        coefficients[:, joint] = turned(turn, coefficients[:, joint])
    moving = (coefficients != rest_coefficients(1)).any(axis=(0, 2)) if len(skeleton.joints) else np.zeros(0, bool)
    used = np.flatnonzero(moving)
    return tuple(skeleton.joints[i] for i in used), coefficients[:, used] if used.size else None


def _another_face(performance: Performance, parts: FaceParts) -> str:
    shapes, first = [*parts.shapes, *(slider.name for slider in parts.sliders)], performance.names[0]
    some = first_names(shapes, 4) or "none, there are none"
    names = f"{len(performance.names)} names ('{first[:40]}' ...) of {Path(performance.where).name}"
    return f"none of its shapes and sliders is among the {names}, expected some of {some}{did_you_mean(first, shapes)}"
