"""Controls of a neural rig for points by Adam, through the frozen network and skin."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from facepipe.core.arrays import FloatArray
from facepipe.rig.bone_coefficients import rest_coefficients
from facepipe.rig.neural_rig import NeuralRig, share_limits
from facepipe.rig.torch.one_thread import one_thread
from facepipe.rig.torch.rig import DifferentiableRig, under

LAST_RATE = 0.01  # of the first


def descend(
    rig: NeuralRig,
    points: FloatArray,
    start: FloatArray | None,
    *,
    steps: int,
    rate: float,
    l1: float,
    seed: int,
    done: Callable[[], object] = lambda: None,
) -> FloatArray:
    """(f, c) shares of ranges from defaults, within limits, for (f, n, 3) millimetres; all frames in one batch.

    Source: neural-face-rig, S301-S303.

    :param start: (f, c) shares to start from; None: drawn from the ranges by `seed`
    :param rate: the first, of the ranges
    :param l1: mm^2 that a share costs
    :param done: called once for each step
    """
    low, high = share_limits(rig.controls)
    if start is None:
        start = np.random.default_rng(seed).uniform(low, high, (len(points), len(low)))
    with one_thread():
        distance = _Distance(rig, points)
        lower, upper, x = _tensor(low), _tensor(high), _tensor(start).requires_grad_()
        optimiser = torch.optim.Adam([x], lr=rate)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps, LAST_RATE * rate)
        for _ in range(steps):
            optimiser.zero_grad()
            (distance(x) + l1 * x.abs().sum()).backward()
            optimiser.step()
            schedule.step()
            # Projected after the step: clamped within the loss, what is beyond its limits would get no gradient back.
            with torch.no_grad():
                x.clamp_(lower, upper)
            done()
        return np.asarray(x.detach().numpy(), dtype=np.float64)


class _Distance:
    """Sum over the frames of mean squared distances, mm^2.

    Without bones it is that of activations: shapes are orthonormal, and what they leave does not change.
    """

    def __init__(self, rig: NeuralRig, points: FloatArray) -> None:
        self._linear, self._hidden, self._last = _tensor(rig.linear), _tensor(rig.hidden), _tensor(rig.last)
        self._hidden_bias, self._last_bias = _tensor(rig.hidden_bias), _tensor(rig.last_bias)
        shapes = rig.shapes.reshape(len(rig.shapes), -1)
        self._count, self._number = len(rig.rest), len(shapes)
        self._skin = None if rig.bones is None else DifferentiableRig(rig.bones)
        if rig.bones is None:
            moved = [shapes @ (own - rig.rest).ravel() for own in points]
            self._targets = _tensor(np.stack(moved))
            return
        self._shapes, self._targets, self._rest = _tensor(shapes), _tensor(points), _tensor(rig.rest)
        joints = len(rig.bones.joints)
        self._coefficients = _tensor(rest_coefficients(joints).ravel())
        self._channels = torch.as_tensor(rig.channels[:, 0] * 9 + rig.channels[:, 1])

    def __call__(self, x: Tensor) -> Tensor:
        units = x @ self._hidden.T + self._hidden_bias
        outputs = x @ self._linear + torch.nn.functional.silu(units) @ self._last.T + self._last_bias
        found, skin, number = outputs, self._skin, self._number
        if skin is not None:  # (f, n, 3)
            frames = len(outputs)
            morphed = self._rest + (outputs[:, :number] @ self._shapes).reshape(frames, -1, 3)
            flat = self._coefficients.expand(frames, -1).index_add(1, self._channels, outputs[:, number:])
            found = under(skin.blended(skin.skinning_matrices(flat.reshape(frames, -1, 9))), morphed)
        return (found - self._targets).square().sum() / self._count


def _tensor(values: FloatArray) -> Tensor:
    return torch.as_tensor(np.ascontiguousarray(values), dtype=torch.float32)
