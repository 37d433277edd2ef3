"""Examples of a rig: what its controls were set to, and where the points went.

Then those of a face's own rig: its controls as clips move them and set in many ways; baked to a file too.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray, require_finite
from facepipe.core.errors import InputError, TopologyError
from facepipe.core.names import first_names
from facepipe.core.reports import Report
from facepipe.geometry.vectors import transformed
from facepipe.neural.options import FrameBlocksOptions, SampleMotionOptions
from facepipe.parts import FaceParts
from facepipe.rig import Rig, build, slide
from facepipe.rig.neural_rig import Control, bones_in, coefficients_in
from facepipe.stage import Face
from facepipe.stage.controls_over_time import Clip, read_clips, save_point_cache
from facepipe.verbs.whole_faces import MILLIMETRES, Topology, world_to_world

_OUTSIDE = 1e-6  # of a control's range: what rounding may take a value beyond its limits
_GAP = 2.5  # steps
_SHOWN = 6  # names of a list
_WHOLE = FrameBlocksOptions(block=1_000_000, margin=0)  # clips are cut where they are learned from
_APART = 3.0  # time codes from a clip's last frame to the next one's first: readers take more than 2.5 for an end


@dataclass(frozen=True, kw_only=True)
class Motion:
    """f frames of c controls and n whole points; frames of one block follow one another, and are kept together.

    :raises InputError: no frame, NaN or infinity, values out of a control's range, or two controls of one name
    :raises TopologyError: numbers of frames, controls or points that don't fit
    """

    where: str
    topology: Topology
    controls: tuple[Control, ...]
    values: FloatArray  # (f, c)
    points: FloatArray  # (f, n, 3) millimetres
    rest: FloatArray  # (n, 3) millimetres, of all controls at their defaults
    blocks: IntArray  # (f,)
    bones: Rig | None = None  # in millimetres, without shapes; None: joints are unknown
    coefficients: FloatArray | None = None  # (f, j, 9) of the bones, translations in millimetres
    source: str = "rig"  # of the frames: facepipe's own rig, "rig and clips", or "samples" of a stage
    between: int = 0  # other frames, left out where clips were cut into blocks
    warnings: tuple[str, ...] = ()  # on what of them was left out

    def __post_init__(self) -> None:
        frames, count = len(self.values), self.topology.point_count
        if not frames or not self.controls:
            raise InputError(self.where, f"{frames} frames of {len(self.controls)} controls, expected some")
        sizes: list[tuple[str, FloatArray | IntArray | None, tuple[int, ...]]] = [
            ("controls", self.values, (frames, len(self.controls))),
            ("points", self.points, (frames, count, 3)),
            ("rest", self.rest, (count, 3)),
            ("blocks", self.blocks, (frames,)),
        ]
        if self.bones is not None or self.coefficients is not None:
            joints = () if self.bones is None else (frames, len(self.bones.joints), 9)
            sizes.append(("bone coefficients", self.coefficients, joints))
        for label, array, shape in sizes:
            if array is None or array.shape != shape:
                found = None if array is None else array.shape
                raise TopologyError(f"{self.where} -> {label}", f"shape {found}, expected {shape}")
        names = [control.name for control in self.controls]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise InputError(f"{self.where} -> {twice}", "two controls of this name, expected one")
        for values, what in ((self.values, "controls"), (self.points, "points"), (self.rest, "rest")):
            require_finite(values, self.where, what)
        if self.coefficients is not None:
            require_finite(self.coefficients, self.where, "bone coefficients")
        # What learns of it maps values to shares of ranges, and does not ask again.
        for number, control in enumerate(self.controls):
            low, high, own = control.minimum, control.maximum, self.values[:, number]
            if not low < high:
                raise InputError(f"{self.where} -> {control.name}", f"from {low:g} to {high:g}, expected a range")
            room = _OUTSIDE * (high - low)
            out = np.flatnonzero((own < low - room) | (own > high + room))
            if len(out):
                what = f"{own[out[0]]:g} in frame {out[0]}, expected {low:g} to {high:g}"
                raise InputError(f"{self.where} -> {control.name}", what)

    def morphed(self, frame: int) -> FloatArray:
        """(n, 3) points of a frame before its bones moved them; those of the frame itself where there are none."""
        points = np.asarray(self.points[frame], dtype=np.float64)
        if self.bones is None or self.coefficients is None:
            return points
        local = self.bones.local_transforms(self.coefficients[frame])
        return self.bones.unskin(points, self.bones.skinning_matrices(local))

    @property
    def constant(self) -> tuple[str, ...]:
        """Controls that no frame moves: nothing can be learned of them."""
        still = np.ptp(self.values, axis=0) == 0.0
        return tuple(control.name for control, one in zip(self.controls, still, strict=True) if one)

    def without(self, names: Sequence[str]) -> Motion:
        """The same without some controls."""
        kept = [number for number, control in enumerate(self.controls) if control.name not in names]
        return replace(self, controls=tuple(self.controls[number] for number in kept), values=self.values[:, kept])

    def frames(self, chosen: IntArray) -> Motion:
        """Some of the frames."""
        coefficients = None if self.coefficients is None else self.coefficients[chosen]
        return replace(
            self,
            values=self.values[chosen],
            points=self.points[chosen],
            blocks=self.blocks[chosen],
            coefficients=coefficients,
        )

    def split(self, held_out: float, seed: int) -> tuple[Motion, Motion]:
        """Frames to learn from, and about a share `held_out` of them to check on: whole blocks, drawn by `seed`.

        Neighbouring frames of a clip are nearly the same; held out one by one, they would have been learned.

        :raises InputError: a single block
        """
        blocks = np.random.default_rng(seed).permutation(np.unique(self.blocks))
        if len(blocks) < 2:
            raise InputError(self.where, "one block of frames, expected two or more: one to learn from, one to check")
        sizes = np.array([np.count_nonzero(self.blocks == block) for block in blocks])
        taken = int(np.searchsorted(np.cumsum(sizes), held_out * sizes.sum(), side="right"))
        checked = np.isin(self.blocks, blocks[: min(max(taken, 1), len(blocks) - 1)])
        return self.frames(np.flatnonzero(~checked)), self.frames(np.flatnonzero(checked))


def frame_blocks(codes: FloatArray, values: FloatArray, options: FrameBlocksOptions) -> tuple[IntArray, IntArray]:
    """The frames to use (k,), and their blocks (k,) from 0.

    A clip ends where more than two steps pass without a frame, unless the controls are held there (writers leave out
    what does not change). A step is the shortest time between two frames, at least one time code. Longer clips than a
    block are cut into even pieces; the first frames after a cut are left out: neighbours of what is held out are
    nearly the same, and would give it away.

    :param codes: (f,) ascending time codes
    :param values: (f, c) of the controls
    """
    apart = np.diff(codes)
    step = max(1.0, float(apart.min())) if len(apart) else 1.0
    ends = (apart > _GAP * step) & (values[1:] != values[:-1]).any(axis=1)
    kept = []
    for clip in np.split(np.arange(len(codes)), np.flatnonzero(ends) + 1):
        for number, piece in enumerate(np.array_split(clip, max(1, round(len(clip) / options.block)))):
            kept.append(piece[options.margin if number else 0 :])
    return np.concatenate(kept), np.repeat(np.arange(len(kept)), [len(one) for one in kept])


@dataclass(frozen=True, kw_only=True)
class RecordedClips:
    """Frames of controls without points: a face's own rig says where these go."""

    values: FloatArray  # (f, c)
    blocks: IntArray  # (f,)
    between: int = 0  # other frames, left out where clips were cut into blocks
    warnings: tuple[str, ...] = ()

    def after(self, values: FloatArray, blocks: IntArray) -> tuple[FloatArray, IntArray]:
        """Other frames, and these after them, in blocks of their own."""
        start = 1 + int(blocks.max(initial=-1))
        return np.concatenate([values, self.values]), np.concatenate([blocks, start + self.blocks])


@dataclass(frozen=True, kw_only=True)
class ReadClips:
    """Reads what moves the controls of a face on stages, its own among them, by name.

    Numbers ``facepipe:control:<name>`` are one clip, sliders with time samples another, and each SkelAnimation with
    shapes one; controls that a clip lacks stay at their defaults. Frames are the times of the samples.
    """

    options: FrameBlocksOptions = field(default_factory=FrameBlocksOptions)

    def __call__(self, paths: Sequence[Path], controls: Sequence[Control]) -> RecordedClips:
        """The frames of all clips, within the controls' limits.

        :raises InputError: no readable USD, a stage without a control of these, or NaN
        """
        frames = RecordedClips(values=np.zeros((0, len(controls))), blocks=np.zeros(0, dtype=int))
        warnings: list[str] = []
        places = {control.name: number for number, control in enumerate(controls)}
        for path in paths:
            clips, lines = _known(path, read_clips(path), controls)
            warnings += lines
            for clip in clips:
                codes = np.unique(np.concatenate([track.codes for track in clip.tracks]))
                codes = codes if len(codes) else np.zeros(1)  # a pose
                rows = np.tile([control.default for control in controls], (len(codes), 1))
                for track in clip.tracks:
                    rows[:, places[track.name]] = track.at(codes)
                kept, numbers = frame_blocks(codes, rows, self.options)
                values, blocks = RecordedClips(values=rows[kept], blocks=numbers).after(frames.values, frames.blocks)
                between = frames.between + len(codes) - len(kept)
                frames = RecordedClips(values=values, blocks=blocks, between=between)
        # values within limits, as a rig clamps them, and a line where some were beyond
        low, high = (np.array([getattr(one, key) for one in controls]) for key in ("minimum", "maximum"))
        held = np.clip(frames.values, low, high)
        moved = (held != frames.values).any(axis=0)
        beyond = [control.name for control, one in zip(controls, moved, strict=True) if one]
        if beyond:
            warnings.append(f"clips go beyond the limits of {first_names(beyond, _SHOWN)}, and are held there")
        return replace(frames, values=held, warnings=tuple(warnings))


def _known(path: Path, clips: Sequence[Clip], controls: Sequence[Control]) -> tuple[list[Clip], list[str]]:
    """Clips of the face's controls only, and lines on what else they move."""
    names = {control.name for control in controls}
    known, warnings = [], []
    for clip in clips:
        others = [track.name for track in clip.tracks if track.name not in names]
        tracks = tuple(track for track in clip.tracks if track.name in names)
        if tracks:
            known.append(Clip(name=clip.name, tracks=tracks))
        left = []
        if tracks and others:
            left.append(f"{len(others)} names that are no controls of the face: {first_names(others, _SHOWN)}")
        if tracks and clip.moves_joints:
            left.append("joints, which are no controls")
        warnings += [f"{path} -> {clip.name}: left out {one}" for one in left]
    if not known:
        there = first_names([track.name for clip in clips for track in clip.tracks], _SHOWN) or "nothing"
        raise InputError(path, f"moves {there}, expected some of {first_names([one.name for one in controls], _SHOWN)}")
    return known, warnings


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
        motion = evaluated(parts, where, controls, values, blocks, lambda row: _posed(parts, controls, row), done)
        if clips is None:
            return motion
        return replace(motion, source="rig and clips", between=clips.between, warnings=clips.warnings)


def evaluated(
    parts: FaceParts,
    where: str,
    controls: tuple[Control, ...],
    values: FloatArray,
    blocks: IntArray,
    pose: Callable[[FloatArray], tuple[FloatArray, Mapping[str, float]]],
    done: Callable[[], object] = lambda: None,
) -> Motion:
    """What the rig of a face makes of (f, c) values.

    :param pose: bone coefficients (j, 9) and shape weights of (c,) values
    :param done: called once for each frame
    """
    rig, to = build(parts), world_to_world(parts.meters_per_unit, parts.up_axis, MILLIMETRES)
    rest = _placed(rig, to, *pose(np.array([control.default for control in controls])))
    points = np.empty((len(values), len(rest), 3), np.float32)
    coefficients = np.empty((len(values), len(rig.joints), 9))
    for number, row in enumerate(values):
        coefficients[number], weights = pose(row)
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
        source="rig",
    )


def _placed(rig: Rig, to: FloatArray, coefficients: FloatArray, weights: Mapping[str, float]) -> FloatArray:
    return transformed(rig.evaluate(weights, coefficients=coefficients), to)


def controls_of(parts: FaceParts, also: Collection[str] = ()) -> tuple[Control, ...]:
    """The sliders that have a range, and the shapes that none of them drives, 0 to 1, in the order of the rig.

    :param also: shapes that are controls though sliders drive them
    """
    # what sliders over modes do is in no rig
    sliders = [slider for slider in parts.sliders if slider.minimum < slider.maximum and not slider.modes]
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
