"""Poses of one side of a face as those of the other."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray
from facepipe.core.errors import InputError
from facepipe.processors.fit_bones.variables import Symmetry
from facepipe.rig import CHANNELS, rest_coefficients


class MirroredJoints:
    """Where the coefficients of m joints go when a pose is mirrored, and their signs there."""

    def __init__(self, symmetry: Symmetry) -> None:
        self.joints = symmetry.joints
        count = len(symmetry.leaders)
        follower = np.flatnonzero(symmetry.leaders != np.arange(count))
        leader = symmetry.leaders[follower]
        self._from, self._signs = np.arange(count), np.where(symmetry.still, -1.0, 1.0)
        self._from[follower], self._from[leader] = leader, follower
        self._signs[follower] = self._signs[leader] = symmetry.signs[follower]
        self._single = np.repeat([joint in symmetry.single for joint in symmetry.joints], 9)

    def coefficients(self, values: FloatArray) -> FloatArray:
        """(m, 9) of the mirrored pose; joints without a partner must be at rest."""
        return np.asarray((self._signs * values.ravel()[self._from]).reshape(values.shape))

    def tied(self, kept: BoolArray) -> BoolArray:
        """(m, 9) channels that are kept, or whose mirror images are."""
        return np.asarray((kept.ravel() | kept.ravel()[self._from]).reshape(kept.shape))

    def limits(self, lower: FloatArray, upper: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(m, 9) limits within which a pose's mirror image is too; joints without a partner rest.

        :raises InputError: limits of two sides that have nothing in common
        """
        low, high, turned = lower.ravel(), upper.ravel(), self._signs < 0
        other = (
            np.where(turned, -high[self._from], low[self._from]),
            np.where(turned, -low[self._from], high[self._from]),
        )
        rest = rest_coefficients(len(self.joints)).ravel()
        low = np.where(self._single, rest, np.maximum(low, other[0]))
        high = np.where(self._single, rest, np.minimum(high, other[1]))
        if (low > high).any():
            joint, channel = divmod(int(np.argmax(low > high)), 9)
            what = "limits whose mirror images have nothing in common with them, expected some that both sides can have"
            raise InputError(f"limits -> {self.joints[joint]} -> {CHANNELS[channel]}", what)
        return low.reshape(lower.shape), high.reshape(upper.shape)
