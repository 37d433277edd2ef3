"""What a network is to give for a motion: activations of few shapes, and the bone coefficients that move."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.differences import cotangent_weights, incidence
from facepipe.geometry.shape_basis import local_basis, motion_basis
from facepipe.neural.motion import Motion
from facepipe.rig import Rig, rest_coefficients
from facepipe.rig.bone_coefficients import coefficient_derivatives

_MOVES = 1e-9  # of a coefficient over all frames; less is rounding
_FIRM = 1e-6  # of the mean square: outputs that do the same are separated by their size


@dataclass(frozen=True, kw_only=True)
class OutputBasis:
    """Shapes of what bones leave, and bones; squares of outputs times the metric are errors of points."""

    rest: FloatArray  # (n, 3) millimetres
    shapes: FloatArray  # (r, n, 3) orthonormal
    channels: IntArray  # (m, 2) joint, coefficient
    metric: FloatArray  # (r + m, r + m) lower triangular; of `output_metric`

    @classmethod
    def from_motion(cls, motion: Motion, tolerance: float, most: int, detail: float) -> OutputBasis:
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
        activations = _morphs(motion, self.rest).reshape(len(motion.values), -1) @ flat.T.astype(np.float32)
        if motion.coefficients is None:
            return np.asarray(activations @ self.metric)
        moved = motion.coefficients - rest_coefficients(motion.coefficients.shape[1])
        return np.concatenate([activations, moved[:, self.channels[:, 0], self.channels[:, 1]]], axis=1) @ self.metric


def _morphs(motion: Motion, rest: FloatArray) -> FloatArray:
    """(f, n, 3) float32: offsets from rest before bones move them."""
    morphs = np.empty(motion.points.shape, np.float32)
    for frame in range(len(morphs)):
        morphs[frame] = motion.morphed(frame) - rest
    return morphs


def output_metric(moves: FloatArray, rest: FloatArray, triangles: IntArray, detail: float) -> FloatArray:
    """(o, o) lower triangular C: ``|outputs C|^2`` is the squared error over all points, to first order.

    Differential coordinates of a point are its offset from the mean of its neighbours (Sorkine, "Differential
    Representations for Mesh Processing", 2006); they show dents that distances hardly do.

    :param moves: (o, n, 3) what a unit of each output moves
    :param detail: what an error of differential coordinates counts beside one of points
    """
    flat = moves.reshape(len(moves), -1)
    products = flat @ flat.T
    if detail > 0.0 and len(triangles):
        edges = cotangent_weights(rest, triangles)[0]
        ends = incidence(edges, len(rest))
        degree = np.maximum(np.bincount(edges.ravel(), minlength=len(rest)), 1)
        bends = ends.T @ (ends @ moves.transpose(1, 0, 2).reshape(len(rest), -1)) / degree[:, None]
        bends = bends.reshape(len(rest), len(moves), 3).transpose(1, 0, 2).reshape(len(moves), -1)
        products += detail * bends @ bends.T
    return np.asarray(np.linalg.cholesky(products + _FIRM * np.trace(products) / len(products) * np.eye(len(products))))


def skinned_moves(bones: Rig, shapes: FloatArray, channels: IntArray) -> FloatArray:
    """(r + m, n, 3) what a unit of each shape's activation and of each bone coefficient moves at rest.

    :param shapes: (r, n, 3) before the bones
    :param channels: (m, 2) joint, coefficient
    """
    matrices = bones.skinning_matrices(bones.rest)[:, :3]
    turned = (bones.influences @ matrices.reshape(-1, 12)).reshape(-1, 3, 4)[:, :, :3]
    return np.concatenate([np.einsum("nij,rnj->rni", turned, shapes), _bone_moves(bones, channels)])


def _bone_moves(bones: Rig, channels: IntArray) -> FloatArray:
    worlds = bones.joint_worlds(bones.rest)
    by_own = bones.rest[:, None] @ coefficient_derivatives(rest_coefficients(len(bones.joints)))
    parents = np.concatenate([worlds, bones.parent_world[None]])[bones.parents]  # -1: what roots hang under
    below = _below(bones)
    moves = np.empty((len(channels), len(bones.points), 3))
    for number, (joint, channel) in enumerate(channels):
        moved_joints = below[joint]
        turn = parents[joint] @ by_own[joint, channel] @ np.linalg.inv(worlds[joint])
        matrices = (turn @ worlds[moved_joints] @ bones.inverse_bind[moved_joints])[:, :3]
        blended = (bones.influences[:, moved_joints] @ matrices.reshape(len(moved_joints), 12)).reshape(-1, 3, 4)
        moves[number] = np.einsum("nij,nj->ni", blended[:, :, :3], bones.points) + blended[:, :, 3]
    return moves


def _below(bones: Rig) -> list[IntArray]:
    """Of each joint: itself and all under it."""
    is_below = np.eye(len(bones.joints), dtype=bool)
    for joint in range(len(bones.joints) - 1, -1, -1):
        if bones.parents[joint] >= 0:
            is_below[bones.parents[joint]] |= is_below[joint]
    return [np.flatnonzero(row) for row in is_below]
