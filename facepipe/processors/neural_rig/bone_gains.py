"""How strongly a subject's bones answer to each control, where a rig was carried to it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.processors.neural_rig.subject_examples import before_bones, subject_examples
from facepipe.rig.neural_jacobian import with_points
from facepipe.rig.neural_rig import NeuralRig, from_default

_POINTS = 400  # that the gains are told by
_STEPS = 3  # of Gauss and Newton: bones turn points, which is nearly straight
_DOUBT = 0.01  # what a squared change of a gain costs, in squares of the noise at a point
_CHANGE = 1e-4  # of a gain: how points answer to it
_SMALLEST = 1e-3  # of what a control does most to a bone coefficient: less is rounding of the training
_NOISES = 10.0 ** np.arange(-3.0, 1.01)  # millimetres


def with_own_gains(rig: NeuralRig, values: FloatArray, points: FloatArray) -> NeuralRig:
    """The rig whose controls move its bones as strongly as the subject's do: a gain on each control's straight part.

    Gains are shared by all points, so frames tell them better than any point's own map; a difference that points can
    make alike by maps of their own counts less (generalised least squares: residuals weighed by the inverse of what
    such maps and the noise are expected to bring). Controls that frames don't tell keep a gain of 1.

    :param values: (f, c) controls of the frames
    :param points: (f, n, 3) millimetres
    """
    turns = np.abs(rig.linear[:, len(rig.shapes) :])
    moving = np.flatnonzero((turns > _SMALLEST * turns.max(axis=0, initial=0.0)).any(axis=1))
    if not len(moving):
        return rig
    chosen = np.arange(0, len(rig.rest), max(1, len(rig.rest) // _POINTS))
    some, points = with_points(rig, chosen), points[:, chosen]
    noise, gains = subject_examples(some, values, points).best_noise(_NOISES), np.ones(len(moving))
    for _ in range(_STEPS):
        now = _scaled(some, moving, gains)
        slopes = _slopes(some, now, moving, values, points)
        matrix, off = subject_examples(now, values, points).normal(slopes, max(noise, 1e-6))
        gains -= np.linalg.solve(matrix + _DOUBT * np.eye(len(moving)), off + _DOUBT * (gains - 1.0))
    return _scaled(rig, moving, gains)


def _scaled(rig: NeuralRig, controls: IntArray, gains: FloatArray) -> NeuralRig:
    linear = rig.linear.copy()
    linear[controls, len(rig.shapes) :] *= gains[:, None]
    return replace(rig, linear=linear)


def _slopes(rig: NeuralRig, now: NeuralRig, controls: IntArray, values: FloatArray, points: FloatArray) -> FloatArray:
    """(f, k, n, 3) how points before bones answer to the gains of k controls."""
    x, outputs, shapes = from_default(rig.controls, values), now.outputs(values), len(rig.shapes)
    still = before_bones(now, outputs, points)
    found = np.zeros((len(x), len(controls), *still.shape[1:]))
    for frame, row in enumerate(x[:, controls]):
        moved = np.flatnonzero(row)
        if not len(moved):
            continue
        changed = np.tile(outputs[frame], (len(moved), 1))
        changed[:, shapes:] += _CHANGE * row[moved, None] * rig.linear[controls[moved], shapes:]
        there = before_bones(now, changed, np.broadcast_to(points[frame], (len(moved), *still.shape[1:])))
        found[frame, moved] = (there - still[frame]) / _CHANGE
    return found
