"""Frames of a subject that a neural rig is carried to, with the rig's controls where these are known."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError, TopologyError
from facepipe.processors.neural_rig.motion import Motion
from facepipe.processors.neural_rig.read_motion import ReadMotion
from facepipe.processors.neural_rig.read_targets import read_targets
from facepipe.rig.neural_rig import NeuralRig
from facepipe.stage.read_controls import read_controls


@dataclass(frozen=True, kw_only=True)
class SubjectFrames:
    """Whole points, and what the controls of the rig were."""

    points: FloatArray  # (f, n, 3) millimetres
    values: FloatArray | None  # (f, c); None: nothing tells
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
    return SubjectFrames(points=motion.points, values=_values(path, motion, rig), between=motion.between)


def _values(path: Path, motion: Motion, rig: NeuralRig) -> FloatArray:
    """(f, c) in the order of the rig, within its limits."""
    names = [control.name for control in motion.controls]
    if not set(names) & {control.name for control in rig.controls}:
        some = ", ".join(control.name for control in rig.controls[:6])
        raise InputError(path, f"controls {', '.join(names[:6])} over time, expected some of {some}")
    found = np.tile(rig.values({}), (len(motion.values), 1))
    for number, control in enumerate(rig.controls):
        if control.name in names:
            column = motion.values[:, names.index(control.name)]
            found[:, number] = np.clip(column, control.minimum, control.maximum)
    return found
