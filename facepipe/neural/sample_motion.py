"""A face's own motion: its controls set in many ways, and where the points go; baked to a file too, with its clips."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.core.reports import Report
from facepipe.geometry.vectors import transformed
from facepipe.neural.motion import Motion, ReadClips, RecordedClips
from facepipe.neural.options import FrameBlocksOptions, SampleMotionOptions
from facepipe.parts import FaceParts
from facepipe.rig import Rig, build, slide
from facepipe.rig.neural_rig import Control, bones_in, coefficients_in
from facepipe.stage import Face
from facepipe.stage.controls_over_time import read_clips
from facepipe.stage.point_cache import save_point_cache
from facepipe.verbs.whole_faces import MILLIMETRES, Topology, world_to_world

_WHOLE = FrameBlocksOptions(block=1_000_000, margin=0)  # clips are cut where they are learned from
_APART = 3.0  # time codes from a clip's last frame to the next one's first: readers take more than 2.5 for an end


@dataclass(frozen=True, kw_only=True)
class SampleMotion:
    """Sets the sliders of a face, and the shapes that no slider drives, and evaluates them with `facepipe.rig`.

    :param also: shapes to set beside the sliders that drive them
    """

    options: SampleMotionOptions = field(default_factory=SampleMotionOptions)
    also: Collection[str] = ()

    def __call__(
        self,
        parts: FaceParts,
        where: str,
        done: Callable[[], object] = lambda: None,
        clips: RecordedClips | None = None,
    ) -> Motion:
        """Frames of whole points, float32.

        :param clips: frames of the face's controls to evaluate too
        :param done: called once for each frame
        :raises InputError: a face without controls, or no frame asked for
        """
        controls = controls_of(parts, self.also)
        if not controls:
            raise InputError(where, "has neither sliders nor shapes, expected something to set")
        values: FloatArray = np.zeros((0, len(controls)))
        blocks: IntArray = np.zeros(0, dtype=int)
        if clips is None or self.options.count(len(controls)):
            values, blocks = plan(controls, self.options)
        if clips is not None:
            values, blocks = clips.after(values, blocks)
        rig, to = build(parts), world_to_world(parts.meters_per_unit, parts.up_axis, MILLIMETRES)
        rest = _placed(rig, to, *_posed(parts, controls, np.array([control.default for control in controls])))
        points = np.empty((len(values), len(rest), 3), np.float32)
        coefficients = np.empty((len(values), len(rig.joints), 9))
        for number, row in enumerate(values):
            coefficients[number], weights = _posed(parts, controls, row)
            points[number] = _placed(rig, to, coefficients[number], weights)
            done()
        bones = bones_in(rig, to) if rig.joints else None
        return Motion(
            where=where,
            topology=Topology.of(parts),
            controls=controls,
            values=values,
            points=points,
            rest=rest,
            blocks=blocks,
            bones=bones,
            # the determinant of a similarity is its scale cubed
            coefficients=None if bones is None else coefficients_in(coefficients, np.cbrt(np.linalg.det(to[:3, :3]))),
            source="rig" if clips is None else "rig and clips",
            between=0 if clips is None else clips.between,
            warnings=() if clips is None else clips.warnings,
        )


def _placed(rig: Rig, to: FloatArray, coefficients: FloatArray, weights: Mapping[str, float]) -> FloatArray:
    return transformed(rig.evaluate(weights, coefficients=coefficients), to)


def controls_of(parts: FaceParts, also: Collection[str] = ()) -> tuple[Control, ...]:
    """The sliders that have a range, and the shapes that none of them drives, 0 to 1, in the order of the rig.

    :param also: shapes that are controls though sliders drive them
    """
    sliders = [slider for slider in parts.sliders if slider.minimum < slider.maximum]
    driven = {shape for slider in sliders for shape, _ in slider.shapes} - set(also) | {
        slider.name for slider in sliders
    }
    found = [
        Control(name=slider.name, minimum=slider.minimum, maximum=slider.maximum, default=slider.default)
        for slider in sliders
    ]
    return (*found, *(Control(name=shape) for shape in parts.shapes if shape not in driven))


def _posed(parts: FaceParts, controls: Sequence[Control], values: FloatArray) -> tuple[FloatArray, dict[str, float]]:
    """(j, 9) bone coefficients and weights of (c,) values: of sliders, and of shapes that none of them drives."""
    given = dict(zip((control.name for control in controls), map(float, values), strict=True))
    settings = {slider.name: given.pop(slider.name, slider.default) for slider in parts.sliders}
    coefficients, weights = slide(parts.sliders, parts.skeleton.joints, settings, parts.slider_network)
    for name, value in given.items():
        weights[name] = weights.get(name, 0.0) + value
    return coefficients, weights


def plan(controls: Sequence[Control], options: SampleMotionOptions) -> tuple[FloatArray, IntArray]:
    """(f, c) values and (f,) blocks: each sweep is a block; what is drawn at random stands alone, a block each.

    :raises InputError: no frame asked for
    """
    low, high, rest = (
        np.array([getattr(control, key) for control in controls]) for key in ("minimum", "maximum", "default")
    )
    pieces, count = [], len(controls)
    for control in range(count if options.sweep else 0):  # from one limit to the other, the others at rest
        frames = np.tile(rest, (options.sweep, 1))
        frames[:, control] = np.linspace(low[control], high[control], options.sweep)
        pieces.append(frames)
    random = np.random.default_rng(options.seed)
    spread = np.zeros((0, count))
    if options.spread:  # of each control, one in each of so many parts of its range (McKay et al. 1979)
        order = np.stack([random.permutation(options.spread) for _ in range(count)], axis=1)
        spread = low + (high - low) * np.asarray((order + random.random((options.spread, count))) / options.spread)
    spread = np.where(_moved(options.spread, count, options.busy, random), spread, rest)
    # Two or three controls anywhere, the others at rest; each control as often as any other.
    together, turns = np.tile(rest, (options.together, 1)), list[int]()
    for row in range(options.together):
        wanted = min(2 + row % 2, count)
        while len(turns) < wanted:
            turns += [one for one in random.permutation(count).tolist() if one not in turns]
        chosen, turns = turns[:wanted], turns[wanted:]
        together[row, chosen] = random.uniform(low[chosen], high[chosen])
    singles = np.concatenate([spread, together])
    sizes = [len(piece) for piece in pieces] + [1] * len(singles)
    values = np.concatenate([*pieces, singles])
    if not len(values):
        raise InputError("motion", "no frame, expected some of spread, sweep or together")
    return values, np.repeat(np.arange(len(sizes)), sizes)


def _moved(count: int, controls: int, busy: float, random: np.random.Generator) -> BoolArray:
    """(count, controls) which of them a frame moves: a share of them up to `busy`, another in each frame."""
    share = np.full(count, 1.0) if busy == 1.0 else busy * random.random(count)
    moved = random.random((count, controls)) < share[:, None]
    moved[np.arange(count), random.integers(controls, size=count)] = True  # no frame stays at rest
    return np.asarray(moved)


@dataclass(frozen=True, kw_only=True)
class BakeReport(Report):
    """What was baked."""

    controls: int
    points: int
    frames: int
    clip_frames: int  # of these, those of recorded clips
    motion_mean_mm: float  # of all points and frames, from rest
    still: tuple[str, ...]  # controls that no frame moves


@dataclass(frozen=True, kw_only=True)
class BakeMotion:
    """Each control through its range, many at once at random, and clips: those of the face that move its controls, and
    others. Evaluated by the face's own rig. Shapes that clips move are controls, whether sliders drive them or not.
    """

    options: SampleMotionOptions = field(default_factory=SampleMotionOptions)
    clips: Sequence[Path] = ()

    def controls(self, parts: FaceParts, path: Path) -> tuple[Control, ...]:
        """The controls of a face, whose stage is at `path`."""
        return controls_of(parts, self._moved(path))

    def __call__(
        self, face: Face, path: Path, out: str | os.PathLike[str], done: Callable[[], object] = lambda: None
    ) -> BakeReport:
        """Bake it to `out`, which `ReadMotion` reads.

        :param path: of the face
        :param done: called once for each frame
        :raises InputError: a face without controls, no frame asked for, a clip of none of its controls, or a file that
            can't be written
        """
        parts, moved = face.parts(), self._moved(path)
        controls = controls_of(parts, moved)
        own = {control.name for control in controls} & _moved_by((path,))
        sources = [*([path] if own else []), *self.clips]
        clips = ReadClips(options=_WHOLE)(sources, controls) if sources and controls else None
        motion = SampleMotion(options=self.options, also=moved)(parts, str(path), done, clips)
        save_point_cache(
            out,
            face.name,
            parts.meshes,
            controls,
            motion.values,
            motion.points,
            motion.rest,
            np.concatenate([[0.0], np.cumsum(np.where(np.diff(motion.blocks), _APART, 1.0))]),
            face.stage.GetTimeCodesPerSecond() or 24.0,
        )
        return BakeReport(
            controls=len(controls),
            points=motion.topology.point_count,
            frames=len(motion.values),
            clip_frames=0 if clips is None else len(clips.values),
            motion_mean_mm=float(np.mean([np.linalg.norm(one - motion.rest, axis=1).mean() for one in motion.points])),
            still=motion.constant,
            warnings=motion.warnings,
        )

    def _moved(self, path: Path) -> set[str]:
        return _moved_by((path, *self.clips))


def _moved_by(paths: Iterable[Path]) -> set[str]:
    """What clips on stages move."""
    return {track.name for path in paths for clip in read_clips(path) for track in clip.tracks}
