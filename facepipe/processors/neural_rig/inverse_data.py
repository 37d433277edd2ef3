"""How far a neural rig's frames are from target points, and how that answers to its controls."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.rig.neural_jacobian import SkinnedPoints, output_derivatives, with_points
from facepipe.rig.neural_rig import NeuralRig, share_limits

_POSES = 3  # where points are weighed, the first at rest
_BUSY = 0.3  # share of the controls that are moved in the others
_EVEN = 0.2  # share of the points that are taken evenly
_RIDGE = 1e-6  # of the mean diagonal: what no point tells counts as little


@dataclass(frozen=True, kw_only=True)
class ShapeData:
    """Of a rig without bones: its shapes are orthonormal, so that distances of activations are those of points.

    Mean over the points of squared distances, mm^2; unknowns are shares of ranges from defaults.
    """

    rig: NeuralRig
    activations: FloatArray  # (f, r) of the shapes nearest to the targets
    left: FloatArray  # (f,) squares that no sum of shapes makes

    @classmethod
    def of(cls, rig: NeuralRig, points: FloatArray) -> ShapeData:
        """Of targets (f, n, 3)."""
        shapes = rig.shapes.reshape(len(rig.shapes), -1)
        activations, squares = np.empty((len(points), len(shapes))), np.empty(len(points))
        for number, frame in enumerate(points):
            moved = (frame - rig.rest).ravel()
            activations[number] = shapes @ moved
            squares[number] = moved @ moved
        left = np.maximum(squares - np.square(activations).sum(axis=1), 0.0)
        return cls(rig=rig, activations=activations, left=left)

    def cost(self, x: FloatArray, frames: IntArray) -> FloatArray:
        """(k,) mm^2 of (k, c)."""
        off = _outputs(self.rig, x) - self.activations[frames]
        return np.asarray((np.square(off).sum(axis=1) + self.left[frames]) / len(self.rig.rest))

    def normal(self, x: FloatArray, frames: IntArray) -> tuple[FloatArray, FloatArray]:
        """(k, c) derivatives and (k, c, c) second ones, those of Gauss and Newton."""
        outputs, by_control = output_derivatives(self.rig, x)
        across, scale = np.swapaxes(by_control, 1, 2), 2.0 / len(self.rig.rest)
        off = outputs - self.activations[frames]
        return scale * (across @ off[..., None])[..., 0], scale * (across @ by_control)


class SkinnedData:
    """Of a rig with bones: distances and derivatives of all points, second derivatives of some that stand for all.

    Some are drawn by how much of the controls they tell (leverage), and weighed by how rarely they are drawn.
    Source: Drineas, Mahoney and Muthukrishnan, "Sampling algorithms for l2 regression and applications", SODA 2006.
    """

    def __init__(self, rig: NeuralRig, points: FloatArray, some: int) -> None:
        """
        :param points: (f, n, 3) targets
        :param some: points for second derivatives
        """
        assert rig.bones is not None
        self.rig, self._targets = rig, points
        self._all = SkinnedPoints(rig, rig.bones)
        chosen, weights = self._chosen(some)
        own = with_points(rig, chosen)
        assert own.bones is not None
        self._some, self._weights = SkinnedPoints(own, own.bones), np.sqrt(weights)

    def cost(self, x: FloatArray, frames: IntArray) -> FloatArray:
        """(k,) mm^2 of (k, c)."""
        found = np.empty(len(x))
        for number, outputs in enumerate(_outputs(self.rig, x)):
            off = self.rig.deformed(outputs) - self._targets[frames[number]]
            found[number] = np.square(off).sum() / len(off)
        return found

    def normal(self, x: FloatArray, frames: IntArray) -> tuple[FloatArray, FloatArray]:
        """(k, c) derivatives and (k, c, c) second ones, those of Gauss and Newton, nearly."""
        slopes, matrices = np.empty_like(x), np.empty((len(x), x.shape[1], x.shape[1]))
        scale = 2.0 / len(self.rig.rest)
        for number in range(len(x)):
            outputs, by_control = (one[0] for one in output_derivatives(self.rig, x[number : number + 1]))
            off = self.rig.deformed(outputs) - self._targets[frames[number]]
            slopes[number] = scale * by_control.T @ self._all.gradient(outputs, off)
            by_point = self._some.derivatives(outputs) * self._weights
            moved = by_control.T @ by_point.reshape(len(by_point), -1)
            matrices[number] = scale * (moved @ moved.T)
        return slopes, matrices

    def _chosen(self, some: int) -> tuple[IntArray, FloatArray]:
        """Points, and for how many each counts."""
        count = len(self.rig.rest)
        if count <= some:
            return np.arange(count), np.ones(count)
        shares = np.full(count, _EVEN / count)
        ends, controls = share_limits(self.rig.controls), len(self.rig.controls)
        random = np.random.default_rng(0)
        for pose in range(_POSES):
            x = random.uniform(*ends) * (random.random(controls) < (_BUSY if pose else 0.0))
            outputs, by_control = (one[0] for one in output_derivatives(self.rig, x[None]))
            moved = (by_control.T @ self._all.derivatives(outputs).reshape(len(outputs), -1)).reshape(len(x), 3, -1)
            shares += (1.0 - _EVEN) / _POSES * _leverage(moved)
        places = (np.arange(some) + 0.5) / some * shares.sum()
        chosen, times = np.unique(np.searchsorted(np.cumsum(shares), places), return_counts=True)
        return chosen, times * shares.sum() / (some * shares[chosen])


def _outputs(rig: NeuralRig, x: FloatArray) -> FloatArray:
    from scipy.special import expit

    units = x @ rig.hidden.T + rig.hidden_bias
    return np.asarray(x @ rig.linear + (units * expit(units)) @ rig.last.T + rig.last_bias)


def _leverage(moved: FloatArray) -> FloatArray:
    """(n,) shares of the points in what is known of the controls, of (c, 3, n) how they move the points."""
    flat = moved.reshape(len(moved), -1)
    matrix = flat @ flat.T
    matrix += _RIDGE * max(float(np.trace(matrix)) / len(matrix), 1e-30) * np.eye(len(matrix))
    told = (flat * np.linalg.solve(matrix, flat)).sum(axis=0).reshape(3, -1).sum(axis=0)
    return np.asarray(told / max(float(told.sum()), 1e-30))
