"""Frames of clips in blocks that can be held out."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.processors.neural_rig.options import FrameBlocksOptions

_GAP = 2.5  # steps


def frame_blocks(codes: FloatArray, values: FloatArray, options: FrameBlocksOptions) -> tuple[IntArray, IntArray]:
    """The frames to use (k,), and their blocks (k,) from 0.

    A clip ends where more than two steps pass without a frame, unless the controls are held there (writers leave out
    what does not change). A step is the shortest time between two frames, at least one time code. Longer clips than a
    block are cut into even pieces; the first frames after a cut are left out: neighbours of what is held out are
    nearly the same, and would tell it.

    :param codes: (f,) ascending time codes
    :param values: (f, c) of the controls
    """
    apart = np.diff(codes)
    step = max(1.0, float(apart.min())) if len(apart) else 1.0
    ends = (apart > _GAP * step) & (values[1:] != values[:-1]).any(axis=1)
    kept = list(_pieces(np.split(np.arange(len(codes)), np.flatnonzero(ends) + 1), options))
    return np.concatenate(kept), np.repeat(np.arange(len(kept)), [len(one) for one in kept])


def _pieces(clips: list[IntArray], options: FrameBlocksOptions) -> Iterator[IntArray]:
    for clip in clips:
        for number, piece in enumerate(np.array_split(clip, max(1, round(len(clip) / options.block)))):
            yield piece[options.margin if number else 0 :]
