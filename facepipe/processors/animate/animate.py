"""Puts a performance on a face: weights on its shapes, turns on its joints."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from facepipe.errors import InputError
from facepipe.parts import Animation, FaceParts, FloatArray, Recipe
from facepipe.processors.animate.options import AnimateOptions
from facepipe.processors.animate.performance import Performance
from facepipe.processors.animate.shape_keys import ANGLES, matched, shape_key
from facepipe.processors.animate.turned_joints import PARTS, angles_of, joint_of, turned_by_shapes, turns
from facepipe.reports import Report
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
        weights, renamed, no_target = _weights(face.where, parts, performance)
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
    where: str, parts: FaceParts, performance: Performance
) -> tuple[dict[str, FloatArray], dict[str, str], dict[str, str]]:
    """Shape -> (T,) weights; name -> shapes that are called otherwise; name -> why it has no target."""
    shapes = list(dict.fromkeys(shape.name for mesh in parts.meshes for shape in mesh.blendshapes))
    names = [name for name in performance.names if shape_key(name) not in ANGLES]
    found = matched(names, shapes)
    weights: dict[str, FloatArray] = {}
    source: dict[str, str] = {}
    for name, targets in found.items():
        for target in targets:
            if target in weights:
                what = f"'{source[target][:60]}' and '{name[:60]}' are both {target}, expected one of them"
                raise InputError(f"{performance.where} -> {where}", what)
            weights[target], source[target] = performance.values[:, performance.names.index(name)], name
    renamed = {name: ", ".join(targets) for name, targets in found.items() if targets and targets != (name,)}
    return weights, renamed, {name: "no such shape" for name, targets in found.items() if not targets}


def _turned(
    where: str, parts: FaceParts, performance: Performance, options: AnimateOptions, shapes: tuple[str, ...]
) -> tuple[dict[str, str], FloatArray | None, dict[str, str]]:
    """Part -> joint, (T, joints, 9) coefficients, and the angles without target with why."""
    columns = {key: i for i, name in enumerate(performance.names) if (key := shape_key(name)) in ANGLES}
    wanted = dict(zip(PARTS, (options.head, options.left_eye, options.right_eye), strict=True))
    joints: dict[str, str] = {}
    moved: list[FloatArray] = []
    no_target: dict[str, str] = {}
    for part in PARTS:
        joint = joint_of(where, parts.skeleton, part, wanted[part])
        angles = angles_of(columns, performance.values, part)
        if not angles.any():
            continue
        side = part.removesuffix("Eye").lower()
        shown = joint is not None and wanted[part] is None and part != "Head"
        by = turned_by_shapes(parts.meshes, joint, side, shapes) if shown and joint is not None else None
        if joint is None or by is not None:
            why = f"{by} and others turn this eye" if by else "left out" if wanted[part] else "no such joint"
            own = [name for name in performance.names if shape_key(name).startswith(part.lower())]
            no_target |= {name: why for name in own if shape_key(name) in ANGLES}
            continue
        joints[part] = parts.skeleton.joints[joint]
        moved.append(turns(parts.skeleton, parts.up_axis, joint, angles))
    twice = len(set(joints.values())) < len(joints)
    if twice:
        raise InputError(where, f"one joint for two of {', '.join(joints)}, expected different ones")
    return joints, np.stack(moved, axis=1) if moved else None, no_target


def _another_face(performance: Performance, parts: FaceParts) -> str:
    shapes = sorted({shape.name for mesh in parts.meshes for shape in mesh.blendshapes})
    some = ", ".join(shapes[:4]) + (" ..." if len(shapes) > 4 else "") or "none"
    names = f"{len(performance.names)} names ({performance.names[0][:40]} ...)"
    return f"has none of the shapes of {Path(performance.where).name}: {names}, expected some of its own: {some}"
