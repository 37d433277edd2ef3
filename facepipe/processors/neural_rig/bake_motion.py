"""A face's own motion baked: its controls set in many ways, its clips, and the points that they move, over time."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.reports import Report
from facepipe.parts import FaceParts
from facepipe.processors.neural_rig.motion import Motion, ReadClips, RecordedClips
from facepipe.processors.neural_rig.options import FrameBlocksOptions, SampleMotionOptions
from facepipe.processors.neural_rig.sample_motion import SampleMotion, controls_of
from facepipe.rig.neural_rig import Control
from facepipe.stage import Face
from facepipe.stage.point_cache import save_point_cache
from facepipe.stage.read_controls import read_clips

_WHOLE = FrameBlocksOptions(block=1_000_000, margin=0)  # clips are cut where they are learned from
_APART = 3.0  # time codes from a clip's last frame to the next one's first: readers take more than 2.5 for an end


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
            frame_codes(motion.blocks),
            face.stage.GetTimeCodesPerSecond() or 24.0,
        )
        return _report(motion, clips)

    def _moved(self, path: Path) -> set[str]:
        return _moved_by((path, *self.clips))


def frame_codes(blocks: IntArray) -> FloatArray:
    """(f,) time codes: frames of a block follow one another, blocks are apart."""
    return np.concatenate([[0.0], np.cumsum(np.where(np.diff(blocks), _APART, 1.0))])


def _moved_by(paths: Iterable[Path]) -> set[str]:
    """What clips on stages move."""
    return {track.name for path in paths for clip in read_clips(path) for track in clip.tracks}


def _report(motion: Motion, clips: RecordedClips | None) -> BakeReport:
    moved = [np.linalg.norm(points - motion.rest, axis=1).mean() for points in motion.points]
    return BakeReport(
        controls=len(motion.controls),
        points=motion.topology.point_count,
        frames=len(motion.values),
        clip_frames=0 if clips is None else len(clips.values),
        motion_mean_mm=float(np.mean(moved)),
        still=motion.constant,
        warnings=motion.warnings,
    )
