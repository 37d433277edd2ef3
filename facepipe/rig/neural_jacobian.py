"""Derivatives of a neural rig's outputs by its controls, and of its points by its outputs."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy import sparse
from scipy.special import expit

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.rig.bone_coefficients import coefficient_derivatives, coefficient_matrices
from facepipe.rig.neural_rig import NeuralRig
from facepipe.rig.rig import Rig


def output_derivatives(rig: NeuralRig, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(f, r + m) outputs of (f, c) shares of ranges from defaults, within limits, and their derivatives
    (f, r + m, c): ``linear^T + last diag(silu'(u)) hidden``, where ``silu'(u) = s (1 + u (1 - s))`` with s the
    sigmoid."""
    units = x @ rig.hidden.T + rig.hidden_bias
    share = expit(units)
    outputs = x @ rig.linear + (units * share) @ rig.last.T + rig.last_bias
    slopes = share * (1.0 + units * (1.0 - share))
    return outputs, rig.linear.T + (rig.last * slopes[:, None, :]) @ rig.hidden


def with_points(rig: NeuralRig, chosen: IntArray) -> NeuralRig:
    """The same rig of some of its points; its shapes are no longer orthonormal, nor its bones' meshes whole."""
    bones = rig.bones
    if bones is not None:
        influences = sparse.csr_array(bones.influences[chosen])
        bones = dataclasses.replace(bones, points=bones.points[chosen], influences=influences)
    return dataclasses.replace(rig, rest=rig.rest[chosen], shapes=rig.shapes[:, chosen], bones=bones)


class SkinnedPoints:
    """Points of a rig with bones, and how they answer to its outputs: shapes as skinned, and turns of joints.

    A joint above a point moves it through what is below: ``d world_d / d c_ja = G_ja world_d`` for each joint d at or
    below j, with ``G_ja = world_parent(j) rest_j (d M_j / d c_ja) inverse(world_j)``.
    """

    def __init__(self, rig: NeuralRig, bones: Rig) -> None:
        self.rig, self.bones = rig, bones
        self._shapes = np.ascontiguousarray(np.swapaxes(rig.shapes, 1, 2))  # (r, 3, n)
        below = np.eye(len(bones.joints))
        for joint in range(len(bones.joints) - 1, -1, -1):
            if bones.parents[joint] >= 0:
                below[bones.parents[joint]] += below[joint]
        self._joints, self._of = np.unique(rig.channels[:, 0], return_inverse=True)
        self._below = below[self._joints]  # (k, j)
        self._weights = sparse.csr_array(bones.influences[:, : len(bones.joints)])
        self._point = np.repeat(np.arange(len(rig.rest)), np.diff(self._weights.indptr))

    def points(self, outputs: FloatArray) -> FloatArray:
        """(n, 3) millimetres of (r + m,) outputs."""
        return self.rig.deformed(outputs)

    def derivatives(self, outputs: FloatArray) -> FloatArray:
        """(r + m, 3, n) of the points by (r + m,) outputs.

        :raises numpy.linalg.LinAlgError: a joint of scale 0
        """
        morphed = self.rig.morphed(outputs)
        skinning, generators = self._moved(outputs)
        blended = (self.bones.influences @ skinning[:, :3, :3].reshape(-1, 9)).T.reshape(3, 3, -1)
        derivatives = np.empty((len(outputs), 3, len(morphed)))
        shapes = self._shapes
        for axis in range(3):
            row = blended[axis]
            derivatives[: len(shapes), axis] = row[0] * shapes[:, 0] + row[1] * shapes[:, 1] + row[2] * shapes[:, 2]
        derivatives[len(shapes) :] = generators[:, :3] @ self._below_points(morphed, skinning)[self._of]
        return derivatives

    def gradient(self, outputs: FloatArray, by_point: FloatArray) -> FloatArray:
        """(r + m,) derivatives by (r + m,) outputs of what has (n, 3) by the points.

        :raises numpy.linalg.LinAlgError: a joint of scale 0
        """
        morphed = self.rig.morphed(outputs)
        skinning, generators = self._moved(outputs)
        blended = (self.bones.influences @ skinning[:, :3, :3].reshape(-1, 9)).reshape(-1, 3, 3)
        by_shape = self._shapes.reshape(len(self._shapes), -1) @ np.einsum("nij,ni->jn", blended, by_point).ravel()
        places = np.concatenate([morphed, np.ones((len(morphed), 1))], axis=1)
        by_matrix = self._weights.T @ (by_point[:, :, None] * places[:, None, :]).reshape(-1, 12)
        moved = by_matrix.reshape(-1, 3, 4) @ np.swapaxes(skinning[:-1], 1, 2)
        summed = np.tensordot(self._below, moved, axes=1)[self._of]
        return np.concatenate([by_shape, np.einsum("kij,kij->k", generators[:, :3], summed)])

    def _moved(self, outputs: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(j + 1, 4, 4) skinning matrices of outputs, and (m, 4, 4) what a channel does to all below its joint."""
        bones, channels = self.bones, self.rig.channels
        coefficients = self.rig.coefficients(outputs)
        worlds = bones.joint_worlds(bones.rest @ coefficient_matrices(coefficients))
        above = np.concatenate([worlds, bones.parent_world[None]])[bones.parents]  # -1: what roots hang under
        derivatives = coefficient_derivatives(coefficients[self._joints])[self._of, channels[:, 1]]
        change = (above @ bones.rest)[channels[:, 0]] @ derivatives
        skinning = np.concatenate([worlds @ bones.inverse_bind, bones.parent_world[None]])
        return skinning, change @ np.linalg.inv(worlds[self._joints])[self._of]

    def _below_points(self, morphed: FloatArray, skinning: FloatArray) -> FloatArray:
        """(k, 4, n) weighted sums of what joints at or below one of the k make of points, and of the weights."""
        weights, point = self._weights, self._point
        matrices = skinning[weights.indices, :3]
        moved = np.einsum("eij,ej->ie", matrices[:, :, :3], morphed[point]) + matrices[:, :, 3].T
        rows = (*(weights.data * axis for axis in moved), weights.data)
        sums = [
            sparse.csr_array((data, weights.indices, weights.indptr), shape=weights.shape) @ self._below.T
            for data in rows
        ]
        return np.stack([total.T for total in sums], axis=1)
