"""The best that is straight in a rig's controls: what a neural rig is compared with, or is where that is enough."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.geometry.shape_basis import motion_basis
from facepipe.neural.motion import Motion
from facepipe.neural.output_basis import OutputBasis
from facepipe.rig.neural_rig import NeuralRig, from_default

_PENALTIES = 10.0 ** np.arange(-8.0, 3.0, 0.5)  # of the largest singular value's square


@dataclass(frozen=True, kw_only=True)
class Straight:
    """``rest + [x, 1] shapes`` of x, the controls from their defaults."""

    motion: Motion  # that it was fitted to
    shapes: FloatArray  # (c + 1, 3n) millimetres

    def points(self, values: FloatArray) -> FloatArray:
        """(n, 3) of (c,) values."""
        row = np.append(from_default(self.motion.controls, values), 1.0)
        return np.asarray(self.motion.rest + (row @ self.shapes).reshape(-1, 3))


def best_blendshapes(motion: Motion) -> Straight:
    """One blendshape a control, and an offset, of least squared error on all frames."""
    deltas = (motion.points - motion.rest).reshape(len(motion.values), -1)
    return Straight(motion=motion, shapes=np.linalg.lstsq(_rows(motion), deltas, rcond=None)[0])


def ridge(motion: Motion, tolerance: float, most: int) -> Straight:
    """Ridge regression from the controls to principal components; its penalty by generalised cross-validation.

    Source: Golub, Heath, Wahba, Generalized cross-validation as a method for choosing a good ridge parameter (1979).

    :param tolerance: millimetres that the components may leave, RMS
    :param most: components
    """
    components, activations = motion_basis(motion.points - motion.rest, tolerance, most)
    left, sizes, right = np.linalg.svd(_rows(motion), full_matrices=False)
    along = left.T @ activations
    best, least = np.zeros_like(sizes), np.inf
    for penalty in _PENALTIES * sizes[0] ** 2:
        kept = sizes**2 / (sizes**2 + penalty)
        # |(I - A) y|^2 / trace(I - A)^2, with A = U diag(kept) U^T: one decomposition serves every penalty
        off = np.sum(activations**2) - np.sum((1.0 - (1.0 - kept[:, None]) ** 2) * along**2)
        score = off / (len(left) - kept.sum()) ** 2 if len(left) > kept.sum() else np.inf
        if score < least:
            best, least = kept / np.where(sizes > 0.0, sizes, 1.0), score
    weights = right.T @ (best[:, None] * along)
    return Straight(motion=motion, shapes=weights @ components.reshape(len(components), -1))


def _rows(motion: Motion) -> FloatArray:
    x = from_default(motion.controls, motion.values)
    return np.concatenate([x, np.ones((len(x), 1))], axis=1)


def straight_rig(motion: Motion, basis: OutputBasis) -> NeuralRig:
    """The map of least squared error on all frames, which is 0 where the controls are at their defaults."""
    inputs = from_default(motion.controls, motion.values)
    outputs = basis.outputs(motion) @ np.linalg.inv(basis.metric)
    count = outputs.shape[1]
    return NeuralRig(
        controls=motion.controls,
        rest=basis.rest,
        shapes=basis.shapes,
        linear=np.linalg.lstsq(inputs, outputs, rcond=None)[0],
        hidden=np.zeros((0, len(motion.controls))),
        hidden_bias=np.zeros(0),
        last=np.zeros((count, 0)),
        last_bias=np.zeros(count),
        topology=motion.topology.digest,
        bones=motion.bones,
        channels=basis.channels,
    )
