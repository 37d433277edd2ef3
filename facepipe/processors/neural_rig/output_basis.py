"""What a network is to give for a motion: activations of few shapes, and the bone coefficients that move."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from facepipe.geometry.local_basis import local_basis
from facepipe.geometry.motion_basis import motion_basis
from facepipe.processors.neural_rig.motion import Motion
from facepipe.rig import Rig, rest_coefficients
from facepipe.rig.bone_coefficients import coefficient_derivatives

FloatArray = npt.NDArray[np.floating]
IntArray = npt.NDArray[np.integer]

_MOVES = 1e-9  # of a coefficient over all frames; less is rounding


@dataclass(frozen=True, kw_only=True)
class OutputBasis:
    """Shapes of what bones leave, and bones. Squares of outputs count as what they move: millimetres of all points."""

    rest: FloatArray  # (n, 3) millimetres
    shapes: FloatArray  # (r, n, 3) orthonormal
    channels: IntArray  # (m, 2) joint, coefficient
    sizes: FloatArray  # (r + m,) millimetres of all points that a unit of an output moves, root of the sum of squares

    @classmethod
    def of(cls, motion: Motion, tolerance: float, most: int) -> OutputBasis:
        """The basis of a motion.

        :param tolerance: millimetres that the shapes may leave, RMS
        :param most: shapes
        """
        bones = motion.bones
        rest = motion.rest if bones is None else bones.points
        shapes = local_basis(motion_basis(_morphs(motion, rest), tolerance, most)[0])
        channels = np.zeros((0, 2), np.int64)
        sizes = np.ones(len(shapes))
        if bones is not None and motion.coefficients is not None:
            channels = np.argwhere(np.ptp(motion.coefficients, axis=0) > _MOVES)
            sizes = np.concatenate([sizes, moved_by(bones)[channels[:, 0], channels[:, 1]]])
            kept = sizes > 0.0  # what moves no point needs no output
            channels, sizes = channels[kept[len(shapes) :]], sizes[kept]
        return cls(rest=rest, shapes=shapes, channels=channels, sizes=sizes)

    def outputs(self, motion: Motion) -> FloatArray:
        """(f, r + m) of the frames, in the unit of `sizes`."""
        flat = self.shapes.reshape(len(self.shapes), -1)
        found = _morphs(motion, self.rest).reshape(len(motion.values), -1) @ flat.T.astype(np.float32)
        if motion.coefficients is None:
            return np.asarray(found, dtype=np.float64)
        moved = motion.coefficients - rest_coefficients(motion.coefficients.shape[1])
        return np.concatenate([found, moved[:, self.channels[:, 0], self.channels[:, 1]]], axis=1) * self.sizes


def moved_by(bones: Rig) -> FloatArray:
    """(j, 9) how far all points move for a unit of a bone coefficient at rest: root of the sum of squares."""
    worlds = bones.joint_worlds(bones.rest)
    by_own = bones.rest @ np.moveaxis(coefficient_derivatives(rest_coefficients(len(bones.joints))), 1, 0)
    parents = np.concatenate([worlds, bones.parent_world[None]])[bones.parents]  # -1: what roots hang under
    found = np.zeros((len(bones.joints), 9))
    for joint, below in enumerate(_below(bones)):
        weights = bones.influences[:, below]
        for channel in range(9):
            turn = parents[joint] @ by_own[channel, joint] @ np.linalg.inv(worlds[joint])
            matrices = (turn @ worlds[below] @ bones.inverse_bind[below])[:, :3]
            blended = (weights @ matrices.reshape(len(below), 12)).reshape(-1, 3, 4)
            moves = np.einsum("nij,nj->ni", blended[:, :, :3], bones.points) + blended[:, :, 3]
            found[joint, channel] = np.sqrt(np.sum(moves**2))
    return found


def _below(bones: Rig) -> list[IntArray]:
    """Of each joint: itself and all under it."""
    own = np.eye(len(bones.joints), dtype=bool)
    for joint in range(len(bones.joints) - 1, -1, -1):
        if bones.parents[joint] >= 0:
            own[bones.parents[joint]] |= own[joint]
    return [np.flatnonzero(row) for row in own]


def _morphs(motion: Motion, rest: FloatArray) -> FloatArray:
    """(f, n, 3) float32: offsets from rest before bones move them."""
    found = np.empty(motion.points.shape, np.float32)
    for frame in range(len(found)):
        found[frame] = motion.morphed(frame) - rest
    return found
