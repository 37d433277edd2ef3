"""What a network is to give for a motion: activations of few shapes, and the bone coefficients that move."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.shape_basis import local_basis, motion_basis
from facepipe.processors.neural_rig.motion import Motion
from facepipe.processors.neural_rig.output_metric import output_metric, skinned_moves
from facepipe.rig import rest_coefficients

_MOVES = 1e-9  # of a coefficient over all frames; less is rounding


@dataclass(frozen=True, kw_only=True)
class OutputBasis:
    """Shapes of what bones leave, and bones; squares of outputs times the metric are errors of points."""

    rest: FloatArray  # (n, 3) millimetres
    shapes: FloatArray  # (r, n, 3) orthonormal
    channels: IntArray  # (m, 2) joint, coefficient
    metric: FloatArray  # (r + m, r + m) lower triangular; of `output_metric`

    @classmethod
    def of(cls, motion: Motion, tolerance: float, most: int, detail: float) -> OutputBasis:
        """The basis of a motion.

        :param tolerance: millimetres that the shapes may leave, RMS
        :param most: shapes
        :param detail: what an error of differential coordinates counts beside one of points
        """
        bones = motion.bones
        rest = motion.rest if bones is None else bones.points
        moves = shapes = local_basis(motion_basis(_morphs(motion, rest), tolerance, most)[0])
        channels = np.zeros((0, 2), np.int64)
        if bones is not None and motion.coefficients is not None:
            channels = np.argwhere(np.ptp(motion.coefficients, axis=0) > _MOVES)
            moves = skinned_moves(bones, shapes, channels)
            kept = np.abs(moves[len(shapes) :]).any(axis=(1, 2))  # what moves no point needs no output
            channels, moves = channels[kept], np.concatenate([moves[: len(shapes)], moves[len(shapes) :][kept]])
        metric = output_metric(moves, motion.rest, motion.topology.triangles, detail)
        return cls(rest=rest, shapes=shapes, channels=channels, metric=metric)

    def outputs(self, motion: Motion) -> FloatArray:
        """(f, r + m) of the frames, times the metric."""
        flat = self.shapes.reshape(len(self.shapes), -1)
        found = _morphs(motion, self.rest).reshape(len(motion.values), -1) @ flat.T.astype(np.float32)
        if motion.coefficients is None:
            return np.asarray(found @ self.metric)
        moved = motion.coefficients - rest_coefficients(motion.coefficients.shape[1])
        return np.concatenate([found, moved[:, self.channels[:, 0], self.channels[:, 1]]], axis=1) @ self.metric


def _morphs(motion: Motion, rest: FloatArray) -> FloatArray:
    """(f, n, 3) float32: offsets from rest before bones move them."""
    found = np.empty(motion.points.shape, np.float32)
    for frame in range(len(found)):
        found[frame] = motion.morphed(frame) - rest
    return found
