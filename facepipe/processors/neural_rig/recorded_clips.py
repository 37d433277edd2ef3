"""Recorded clips: what controls of a face were set to on stages, frame by frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.processors.neural_rig.frame_blocks import frame_blocks
from facepipe.processors.neural_rig.options import FrameBlocksOptions
from facepipe.rig.neural_rig import Control
from facepipe.stage.control_track import Clip
from facepipe.stage.read_controls import read_clips

_SHOWN = 6  # names of a list


@dataclass(frozen=True, kw_only=True)
class RecordedClips:
    """Frames of controls without points: a face's own rig tells where these go."""

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
        found = RecordedClips(values=np.zeros((0, len(controls))), blocks=np.zeros(0, dtype=int))
        warnings: list[str] = []
        for path in paths:
            clips, told = _known(path, read_clips(path), controls)
            warnings += told
            for clip in clips:
                own = _frames(clip, controls, self.options)
                values, blocks = own.after(found.values, found.blocks)
                found = RecordedClips(values=values, blocks=blocks, between=found.between + own.between)
        held, beyond = _within(found.values, controls)
        return replace(found, values=held, warnings=(*warnings, *beyond))


def _known(path: Path, clips: Sequence[Clip], controls: Sequence[Control]) -> tuple[list[Clip], list[str]]:
    """Clips of the face's controls only, and lines on what else they move."""
    names = {control.name for control in controls}
    known, warnings = [], []
    for clip in clips:
        others = [track.name for track in clip.tracks if track.name not in names]
        own = tuple(track for track in clip.tracks if track.name in names)
        if own:
            known.append(Clip(name=clip.name, tracks=own))
        left = [f"{len(others)} names that are no controls of the face: {_some(others)}"] if own and others else []
        left += ["joints, which are no controls"] if own and clip.moves_joints else []
        warnings += [f"{path} -> {clip.name}: left out {one}" for one in left]
    if not known:
        there = _some([track.name for clip in clips for track in clip.tracks]) or "nothing"
        raise InputError(path, f"moves {there}, expected some of {_some([one.name for one in controls])}")
    return known, warnings


def _frames(clip: Clip, controls: Sequence[Control], options: FrameBlocksOptions) -> RecordedClips:
    """Of one clip, as it goes."""
    codes = np.unique(np.concatenate([track.codes for track in clip.tracks]))
    codes = codes if len(codes) else np.zeros(1)  # a pose
    rows = np.tile([control.default for control in controls], (len(codes), 1))
    places = {control.name: number for number, control in enumerate(controls)}
    for track in clip.tracks:
        rows[:, places[track.name]] = track.at(codes)
    kept, blocks = frame_blocks(codes, rows, options)
    return RecordedClips(values=rows[kept], blocks=blocks, between=len(codes) - len(kept))


def _within(values: FloatArray, controls: Sequence[Control]) -> tuple[FloatArray, list[str]]:
    """Values within limits, as a rig clamps them, and a line where some were beyond."""
    low, high = (np.array([getattr(one, key) for one in controls]) for key in ("minimum", "maximum"))
    held = np.clip(values, low, high)
    beyond = [control.name for control, one in zip(controls, (held != values).any(axis=0), strict=True) if one]
    return held, [f"clips go beyond the limits of {_some(beyond)}, and are held there"] if beyond else []


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:_SHOWN]) + (" ..." if len(names) > _SHOWN else "")
