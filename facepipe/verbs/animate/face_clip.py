"""Puts a performance on a face: weights on its shapes, turns on its joints."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.names import did_you_mean, first_names
from facepipe.core.reports import Report
from facepipe.parts import Animation, FaceParts, Mesh, Recipe, Skeleton
from facepipe.rig.bone_coefficients import coefficient_matrices, matrix_coefficients, rest_coefficients
from facepipe.rig.conventions import match_shapes, meaning, shapes_of, spelling
from facepipe.rig.joint_names import human_joint, joint_called
from facepipe.rig.sliders import slide
from facepipe.rig.trs import decompose, rotation_matrices
from facepipe.rig.visemes import OCULUS_VISEMES
from facepipe.stage import Face
from facepipe.stage.author_changes import author_changes
from facepipe.stage.face import on_frames, play
from facepipe.verbs.animate.options import AnimateOptions
from facepipe.verbs.animate.performance import PARTS, Performance, angle_of

NONE = "none"
_MOVES = 1e-6  # of the head's size: less is no motion
_LIKENED = 100  # names without target for which a like one is looked for
_HELD = 0.5  # weight from which a point belongs to a joint


def joint_of(where: str, skeleton: Skeleton, part: str, wanted: str | None) -> int | None:
    """The joint that a part turns: the one asked for, or the only one with a usual name nearest to the root.

    :param part: Head, LeftEye or RightEye
    :param wanted: its path or last name, or `NONE`
    :raises InputError: no such joint, or several
    """
    if wanted == NONE:
        return None
    names = [joint.rpartition("/")[2] for joint in skeleton.joints]
    if wanted is None:
        return joint_called(skeleton, part)
    paths = [i for i, joint in enumerate(skeleton.joints) if joint == wanted]
    matches = paths or [i for i, name in enumerate(names) if name.casefold() == wanted.casefold()]
    if len(matches) != 1:
        problem = (
            f"{len(matches)} joints '{wanted[:60]}' for {part}" if matches else f"no joint '{wanted[:60]}' for {part}"
        )
        some = first_names(names, 4) or "none, there are none"
        raise InputError(where, f"{problem}, expected a path or name of one: {some}{did_you_mean(wanted, names)}")
    return matches[0]


def turned_by_shapes(meshes: Sequence[Mesh], joint: int, side: str, shapes: Collection[str]) -> str | None:
    """A shape of `shapes` that looks around with the eye of `side` (Left, Right), by moving points of the joint."""
    meant = {shape: meaning(shape) or "" for shape in shapes}
    looks = {shape for shape, one in meant.items() if one.startswith("eyeLook") and one.endswith(side)}
    for mesh in meshes:
        if mesh.skin is None:
            continue
        held = (np.where(mesh.skin.joint_indices == joint, mesh.skin.joint_weights, 0.0)).sum(axis=1) > _HELD
        size = float(np.ptp(mesh.points, axis=0).max(initial=0.0))
        for shape in mesh.blendshapes:
            moved = np.abs(shape.offsets).max(axis=1, initial=0.0) > _MOVES * size
            if shape.name in looks and held[np.asarray(shape.point_indices)[moved]].any():
                return shape.name
    return None


def turns(skeleton: Skeleton, up_axis: str, joint: int, angles: FloatArray) -> FloatArray:
    """(T, 9) coefficients of a joint for (T, 3) yaw, pitch, roll about where it stands at rest."""
    yaw, pitch, roll = (np.asarray(angles, dtype=np.float64) * (-1.0, 1.0, -1.0)).T
    world = _about(yaw, 1) @ _about(pitch, 0) @ _about(roll, 2)
    if up_axis == "Z":  # what is (x, y, z) with Y up is (x, -z, y)
        axes = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
        world = axes @ world @ axes.T
    stands, above = np.eye(4), joint
    while above >= 0:
        stands = np.asarray(skeleton.rest_transforms[above], dtype=np.float64) @ stands
        above = int(skeleton.parents[above])
    rest = rotation_matrices(decompose(np.asarray(skeleton.transform) @ stands).rotation)
    matrices = np.tile(np.eye(4), (len(angles), 1, 1))
    matrices[:, :3, :3] = rest.T @ world @ rest
    found = np.repeat(rest_coefficients(1), len(angles), axis=0)
    found[:, 3:6] = matrix_coefficients(matrices)[:, 3:6]
    return found


def _about(angle: FloatArray, axis: int) -> FloatArray:
    """(T, 3, 3) right-handed rotations about an axis."""
    first, second = (axis + 1) % 3, (axis + 2) % 3
    matrices = np.zeros((len(angle), 3, 3))
    matrices[:, axis, axis] = 1.0
    matrices[:, first, first] = matrices[:, second, second] = np.cos(angle)
    matrices[:, second, first], matrices[:, first, second] = np.sin(angle), -np.sin(angle)
    return matrices


class Driven(NamedTuple):
    """What sliders do on top of the person."""

    coefficients: FloatArray  # (T, j, 9) of all joints
    weights: dict[str, FloatArray]  # shape -> (T,)


def driven(
    parts: FaceParts, tracks: Mapping[str, FloatArray], frames: int, done: Callable[[], object] = lambda: None
) -> Driven:
    """What the sliders of `tracks` do, all others at their defaults.

    :param tracks: slider -> (T,) weights: 0 is its default, 1 its maximum
    :param done: called after every frame
    """
    joints = parts.skeleton.joints
    at_rest = np.tile(rest_coefficients(len(joints)), (frames, 1, 1))
    if not tracks:
        return Driven(at_rest, {})
    needed = {*tracks, *(() if parts.slider_network is None else parts.slider_network.sliders)}
    sliders = [replace(slider, value=None) for slider in parts.sliders if slider.name in needed]
    values = {
        slider.name: slider.default + tracks[slider.name] * (slider.maximum - slider.default)
        for slider in sliders
        if slider.name in tracks
    }
    still, weights_still = slide(sliders, joints, network=parts.slider_network)
    coefficients, weights = at_rest, np.zeros((frames, len(names := parts.shapes)))
    for frame in range(frames):
        now = {name: float(track[frame]) for name, track in values.items()}
        coefficients[frame], own = slide(sliders, joints, now, parts.slider_network)
        weights[frame] = [own.get(name, 0.0) - weights_still.get(name, 0.0) for name in names]
        done()
    if (still != rest_coefficients(len(joints))).any():  # a network that is not quite 0 there
        # C = C_default D: D alone is motion, so that sliders at their defaults leave the face as it is
        matrices = np.linalg.inv(coefficient_matrices(still)) @ coefficient_matrices(coefficients)
        coefficients = matrix_coefficients(matrices)
    moved = np.asarray(weights.any(axis=0))
    return Driven(coefficients, {name: weights[:, i] for i, name in enumerate(names) if moved[i]})


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
    read_as: str = ""  # what the file was found to be, and how it was read
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
            read_as=performance.read_as,
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
    matched = match_shapes(names, [*shapes, *sliders], shapes_of(parts.meshes))
    column_of = {target: columns[name] for name, targets in matched.items() for target in targets}
    # visemes that the face has no shape for: the mix of shapes that makes their mouth, over what the clip says of these
    spoken = {
        name: viseme for name in names if name not in matched and (viseme := meaning(name) or "") in OCULUS_VISEMES
    }
    mouths = {shape for viseme in spoken.values() for shape in OCULUS_VISEMES[viseme]}
    places = match_shapes(mouths, [*shapes, *sliders], shapes_of(parts.meshes))
    for name, viseme in spoken.items():
        mix = {target: share for shape, share in OCULUS_VISEMES[viseme].items() for target in places.get(shape, ())}
        for target, share in mix.items():
            column_of[target] = column_of.get(target, 0.0) + share * columns[name]
        if mix or not OCULUS_VISEMES[viseme]:
            matched[name] = tuple(mix)
    free = [one for one in (*shapes, *sliders) if one not in column_of]
    lacking = "no such shape or slider" if sliders else "no such shape"
    lost = [name for name in names if name not in matched]
    return _Targets(
        {target: column for target, column in column_of.items() if target in shapes},
        {target: column for target, column in column_of.items() if target in sliders},
        {name: ", ".join(targets) for name, targets in matched.items() if targets != (name,)},
        # each is compared with all shapes: of thousands that takes a minute
        {name: lacking + (did_you_mean(name, free) if i < _LIKENED else "") for i, name in enumerate(lost)},
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
        given = wanted[part]
        joint = human_joint(parts, part) if given is None else joint_of(where, parts.skeleton, part, given)
        # (T, 3) yaw, pitch and roll of a part in radians; what a performance lacks of them is 0
        columns = {angle_of(name): column for name, column in zip(performance.names, performance.values.T, strict=True)}
        zero = np.zeros(len(performance.values))
        angles = np.stack([columns.get(f"{part}{angle}", zero) for angle in ("Yaw", "Pitch", "Roll")], axis=1)
        why = "left out" if wanted[part] else "no such joint"
        # an eye that shapes or sliders turn already would turn twice by its joint as well
        if joint is not None and wanted[part] is None and part != "Head":
            path = parts.skeleton.joints[joint]
            by = turned_by_shapes(parts.meshes, joint, part.removesuffix("Eye"), targets.weights)
            by = by or next(
                (
                    slider.name
                    for slider in parts.sliders
                    if slider.name in targets.sliders and any(path == moved for moved, _, _ in slider.channels)
                ),
                None,
            )
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
        # T C: what sliders do to the joint is motion within its turn
        matrices = coefficient_matrices(turn) @ coefficient_matrices(coefficients[:, joint])
        coefficients[:, joint] = matrix_coefficients(matrices)
    moving = (coefficients != rest_coefficients(1)).any(axis=(0, 2)) if len(skeleton.joints) else np.zeros(0, bool)
    used = np.flatnonzero(moving)
    return tuple(skeleton.joints[i] for i in used), coefficients[:, used] if used.size else None


def _another_face(performance: Performance, parts: FaceParts) -> str:
    shapes, first = [*parts.shapes, *(slider.name for slider in parts.sliders)], performance.names[0]
    some = first_names(shapes, 4) or "none, there are none"
    names = f"{len(performance.names)} names ('{first[:40]}' ...) of {Path(performance.where).name}"
    return f"none of its shapes and sliders is among the {names}, expected some of {some}{did_you_mean(first, shapes)}"
