"""Examples of a rig: what its controls were set to, and where the points went."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray, require_finite
from facepipe.core.errors import InputError, TopologyError
from facepipe.core.names import first_names
from facepipe.neural.options import FrameBlocksOptions
from facepipe.rig import Rig
from facepipe.rig.neural_rig import Control
from facepipe.stage.controls_over_time import Clip, read_clips
from facepipe.verbs.whole_faces import Topology

_OUTSIDE = 1e-6  # of a control's range: what rounding may take a value beyond its limits
_GAP = 2.5  # steps
_SHOWN = 6  # names of a list


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
