"""Examples of any rig from a stage: controls over time with the point cache they moved, and frames to invert."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.errors import InputError, TopologyError
from facepipe.geometry.vectors import transformed
from facepipe.neural.motion import Motion, frame_blocks
from facepipe.neural.options import FrameBlocksOptions
from facepipe.parts import Animation, FaceParts
from facepipe.rig import Rig, build, coefficient_matrices, matrix_coefficients, sample_transforms, sample_weights
from facepipe.rig.neural_rig import Control, NeuralRig, bones_in, coefficients_in
from facepipe.stage import open_face
from facepipe.stage.controls_over_time import ControlTrack, PointCache, read_controls, read_point_cache
from facepipe.stage.face import moving_animation
from facepipe.verbs.cached_points import CachedPoints, cached_points
from facepipe.verbs.whole_faces import MILLIMETRES, Topology, world_to_world

_DIGITS = 9  # of time codes: what going by seconds has rounded comes back
_SHEAR = 1e-6  # stage units and shares that bone coefficients may miss a transform by
_GAP = 2.0  # steps without a frame: more, and another clip begins
Codes = npt.NDArray[np.float64]

_SAME = 1e-6  # of a time code


class AnimatedFace:
    """World points of a face that an animation moves, in stage units."""

    def __init__(self, parts: FaceParts, animation: Animation) -> None:
        self.parts, self.animation, self.meshes = parts, animation, parts.meshes
        self.count = animation.samples
        self._rig = build(parts)

    @classmethod
    def read(cls, path: Path) -> AnimatedFace | None:
        """The face of a stage with what moves it; None where nothing does.

        :raises InputError: NaN, or several animations over time of which the skeleton plays none
        """
        face = open_face(path)
        animation = moving_animation(face)
        return None if animation is None else cls(face.parts(), animation)

    def codes(self, codes_per_second: float) -> npt.NDArray[np.float64]:
        """(f,) time codes of the samples; none of a pose."""
        times = self.animation.times
        return np.zeros(0) if times is None else np.round(np.asarray(times) * codes_per_second, _DIGITS)

    def sample(self, number: int) -> FloatArray:
        """(n, 3)."""
        return self._rig.evaluate(sample_weights(self.animation, number), joint_transforms=self._local(number))

    def untimed(self) -> FloatArray:
        """(n, 3) at rest."""
        return self._rig.evaluate()

    def bones(self, to: FloatArray, samples: IntArray) -> tuple[Rig | None, FloatArray | None]:
        """The joints in millimetres, and (k, j, 9) bone coefficients; None without joints, or with sheared ones.

        :param to: (4, 4) from the stage's world
        """
        if not self._rig.joints:
            return None, None
        moves = np.linalg.solve(self._rig.rest, np.stack([self._local(int(number)) for number in samples]))
        coefficients = matrix_coefficients(moves)
        if np.abs(coefficient_matrices(coefficients) - moves).max() > _SHEAR:
            return None, None
        return bones_in(self._rig, to), coefficients_in(coefficients, float(np.cbrt(np.linalg.det(to[:3, :3]))))

    def _local(self, number: int) -> FloatArray:
        return sample_transforms(self.parts.skeleton, self.animation, number)


@dataclass(frozen=True, kw_only=True)
class Targets:
    """Whole points over time."""

    points: FloatArray  # (f, n, 3) millimetres, float32
    codes: FloatArray  # (f,) time codes; none of a pose, f = 1
    codes_per_second: float

    @property
    def blocks(self) -> IntArray:
        """(f,) clips, which end where more than two steps pass without a frame; a step is the shortest time."""
        if len(self.codes) < 2:
            return np.zeros(len(self.points), np.int64)
        apart = np.diff(self.codes)
        return np.concatenate([[0], np.cumsum(apart > _GAP * apart.min())])


def read_targets(path: Path, rig: NeuralRig) -> Targets:
    """The meshes of a stage at their time samples. Without these a face is what its rig makes of the animation that
    moves it, and any other stage what its points are without time; then skins and blendshapes are left out.

    :raises InputError: no readable USD, no mesh, NaN, or several animations of which the skeleton plays none
    :raises TopologyError: other meshes than the rig was learned on
    """
    cache = read_point_cache(path)
    if not cache.meshes:
        raise InputError(path, "no mesh, expected those that the neural rig was learned on")
    codes: FloatArray = cache.codes
    animated = None
    if cache.has_face and not len(codes):
        animated = AnimatedFace.read(path)
        codes = codes if animated is None else animated.codes(cache.codes_per_second)
    placed = animated or cached_points(cache, path)
    topology = Topology.of(FaceParts(meshes=placed.meshes))
    if topology.digest != rig.topology:
        what = f"meshes {', '.join(topology.names[:4])} of {topology.point_count:,} points"
        expected = f"expected those that the neural rig was learned on, of {len(rig.rest):,} points, with their faces"
        raise TopologyError(path, f"{what}, {expected}")
    to = world_to_world(cache.meters_per_unit, cache.up_axis, MILLIMETRES)
    points = np.empty((placed.count, len(rig.rest), 3), np.float32)
    for number, own in enumerate(points):
        own[:] = transformed(placed.sample(number), to)
    return Targets(points=points, codes=codes, codes_per_second=cache.codes_per_second)


@dataclass(frozen=True, kw_only=True)
class ReadMotion:
    """Reads what another program baked of its own rig; docs/neural_rig.md has the convention.

    :param prims: paths of prims whose own numbers are the controls; none for what the convention says
    """

    options: FrameBlocksOptions = field(default_factory=FrameBlocksOptions)
    prims: Sequence[str] = ()

    def __call__(self, path: Path) -> Motion:
        """The frames of a stage, float32.

        Frames are the times at which controls or points have samples; what has none at a time must be held there. Rest
        is the first frame with all controls at their defaults, else the points authored without time. Where no mesh
        has points over time, a face is what its rig makes of the SkelAnimation that moves it, at the samples of that.

        :raises InputError: no readable USD, no controls, nothing that moves points, a single frame, NaN, values beyond
            limits, no rest, or a time at which controls or points are not known
        :raises TopologyError: a mesh whose number of points changes
        """
        tracks = read_controls(path, self.prims)
        sampled = sorted({float(code) for track in tracks for code in track.codes})
        if not sampled:
            what = "no control with time samples, expected facepipe:control:<name>, sliders or shape weights"
            raise InputError(path, what)
        cache = read_point_cache(path, also=sampled)
        if not cache.moving.any():
            return self._animated(path, tracks, np.array(sampled), cache)
        if len(cache.codes) < 2:
            raise InputError(path, "one frame, expected several")
        guessed = [(mesh.mesh.name, mesh.guessed) for mesh in cache.meshes]
        _check_times(path, tracks, np.array(sampled), cache.codes, cache.codes[cache.moving], guessed)
        return self._motion(path, tracks, cache, cached_points(cache, path), cache.codes)

    def _animated(self, path: Path, tracks: Sequence[ControlTrack], sampled: Codes, cache: PointCache) -> Motion:
        """The frames of a face that a SkelAnimation moves, with its bones."""
        face = AnimatedFace.read(path) if cache.has_face else None
        moving = np.zeros(0)
        if face is not None:  # time codes next to those of controls are these: they went by seconds
            moving = face.codes(cache.codes_per_second)
            near = sampled[np.clip(np.searchsorted(sampled, moving - _SAME), 0, len(sampled) - 1)]
            moving = np.where(np.abs(near - moving) < _SAME, near, moving)
        if face is None or not len(moving):
            what = "expected meshes whose points have time samples, or a face that a SkelAnimation moves over time"
            raise InputError(path, f"no point cache, {what}")
        if len(moving) < 2:
            raise InputError(path, "one frame, expected several")
        codes = np.union1d(sampled, moving)
        between = ~np.isin(codes, moving) & (codes > moving[0]) & (codes < moving[-1])
        _check_times(path, tracks, sampled, codes, moving, [(face.animation.name, between)])
        return self._motion(path, tracks, cache, face, moving)

    def _motion(
        self,
        path: Path,
        tracks: Sequence[ControlTrack],
        cache: PointCache,
        placed: CachedPoints | AnimatedFace,
        codes: Codes,
    ) -> Motion:
        controls = []
        for track in tracks:  # limits that are not authored are how far it goes; of one that never moves, any
            default = float(track.values[0]) if track.default is None else track.default
            low = min(default, float(track.values.min())) if track.minimum is None else track.minimum
            high = max(default, float(track.values.max())) if track.maximum is None else track.maximum
            if not low <= default <= high:
                raise InputError(f"{path} -> {track.where}", f"default {default:g}, expected {low:g} to {high:g}")
            high = high if low < high else low + 1.0
            controls.append(Control(name=track.name, minimum=low, maximum=high, default=default))
        values = np.stack([track.at(codes) for track in tracks], axis=1)
        chosen, blocks = frame_blocks(codes, values, self.options)
        to = world_to_world(cache.meters_per_unit, cache.up_axis, MILLIMETRES)
        at_rest = np.flatnonzero((values == [control.default for control in controls]).all(axis=1))
        if len(at_rest):
            rest = transformed(placed.sample(int(at_rest[0])), to)
        elif placed.untimed is not None:
            rest = transformed(placed.untimed(), to)
        else:
            what = "no frame with all controls at their defaults, and no points without time, expected one of them"
            raise InputError(path, what)
        points = np.empty((len(chosen), *rest.shape), np.float32)
        for own, number in zip(points, chosen, strict=True):
            own[:] = transformed(placed.sample(int(number)), to)
        bones, coefficients = placed.bones(to, chosen) if isinstance(placed, AnimatedFace) else (None, None)
        return Motion(
            where=str(path),
            topology=Topology.of(FaceParts(meshes=placed.meshes)),
            controls=tuple(controls),
            values=values[chosen],
            points=points,
            rest=rest,
            blocks=blocks,
            bones=bones,
            coefficients=coefficients,
            source="samples",
            between=len(values) - len(chosen),
        )


def _check_times(
    path: Path,
    tracks: Sequence[ControlTrack],
    sampled: Codes,
    codes: Codes,
    moving: Codes,
    points: Sequence[tuple[str, BoolArray]],
) -> None:
    """:param codes: (f,) of controls and points
    :param moving: those at which points are sampled
    :param points: what holds points, and (f,) whether they are between two samples that differ
    :raises InputError: the first time at which controls or points are not known
    """
    # Held values beyond the samples, or mixed ones between two, would be learned as if they were known.
    faults: list[tuple[float, str, str]] = []
    for name, known, ends in (("points", sampled, moving), ("controls", moving, sampled)):
        beyond = known[(known < ends[0]) | (known > ends[-1])]
        if len(beyond):
            faults.append((float(beyond[0]), name, f"sampled from {ends[0]:g} to {ends[-1]:g} only"))
    between = "no sample, between two that differ"
    for name, guessed in (*((track.where, track.guessed(codes)) for track in tracks), *points):
        faults += [(float(code), name, between) for code in codes[guessed][:1]]
    if faults:
        code, name, fault = min(faults)
        expected = "expected controls and points sampled at the same times"
        raise InputError(f"{path} -> {name} -> time code {code:g}", f"{fault}, {expected}")


@dataclass(frozen=True, kw_only=True)
class SubjectFrames:
    """Whole points, and what the controls of the rig were."""

    points: FloatArray  # (f, n, 3) millimetres
    values: FloatArray | None  # (f, c); None: unknown
    between: int = 0  # other frames, left out where clips were cut into blocks


def read_subject_frames(path: Path, rig: NeuralRig) -> SubjectFrames:
    """Points over time, and controls over time where the stage has both, by name; others are at their defaults.

    :raises InputError: no readable USD, NaN, or controls of which the rig has none
    :raises TopologyError: other meshes than the rig was learned on
    """
    if not any(len(track.codes) for track in read_controls(path)):
        return SubjectFrames(points=read_targets(path, rig).points, values=None)
    motion = ReadMotion()(path)
    if motion.topology.digest != rig.topology:
        raise TopologyError(path, "other meshes than those of the neural rig, expected its topology")
    names = [control.name for control in motion.controls]
    if not set(names) & {control.name for control in rig.controls}:
        some = ", ".join(control.name for control in rig.controls[:6])
        raise InputError(path, f"controls {', '.join(names[:6])} over time, expected some of {some}")
    values = np.tile(rig.values({}), (len(motion.values), 1))
    for number, control in enumerate(rig.controls):
        if control.name in names:
            column = motion.values[:, names.index(control.name)]
            values[:, number] = np.clip(column, control.minimum, control.maximum)
    return SubjectFrames(points=motion.points, values=values, between=motion.between)
