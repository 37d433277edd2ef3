"""What is a subject's own, by a fully connected network of the whole deformation: the document's second submodel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.geometry.shape_basis import motion_basis
from facepipe.neural.options import SampleMotionOptions
from facepipe.neural.output_basis import output_metric, skinned_moves
from facepipe.neural.sample_motion import plan
from facepipe.rig.neural_rig import NeuralRig, from_default, with_basis

_INPUTS = 256  # coordinates of a deformation, at most
_SMALLEST = 1e-3  # of the largest deviation: less is no coordinate
_SAMPLES = SampleMotionOptions(spread=4000, sweep=4, together=1000)
_WIDTH = 256  # of the network's layers
_UNITS, _STEPS, _PATIENCE, _SPARSITY = 128, 4000, 1000, 0.05  # of the one layer that stands for it


def learned_by_network(
    base: NeuralRig, values: FloatArray, moved: FloatArray, *, noise: float, steps: int, tolerance: float, most: int
) -> NeuralRig:
    """The carried rig with what frames of the subject are beyond it, as one neural rig again.

    Inputs of the network are principal coordinates of the carried rig's deformations, over all that its controls do;
    outputs those of `moved`. Units of one layer learn of samples what it adds, since two layers are no neural rig.

    :param values: (f, c) controls of the frames
    :param moved: (f, n, 3) millimetres beyond the carried rig, before bones
    :param noise: strength at first, in the root mean square of the coordinates' deviations
    :param tolerance: millimetres that the shapes may leave, RMS
    :param most: shapes
    """
    from facepipe.neural.learning.deformation_network import train_deformation_network

    sampled, _ = plan(base.controls, _SAMPLES)
    moves = base.shapes if base.bones is None else skinned_moves(base.bones, base.shapes, base.channels)
    metric = output_metric(moves, base.rest, np.zeros((0, 3), np.int64), 0.0)
    middle, axes, deviations = _coordinates(base.outputs(sampled) @ metric)
    own_shapes, amounts = motion_basis(moved, tolerance, most)
    network = train_deformation_network(
        (base.outputs(values) @ metric - middle) @ axes,
        amounts,
        deviations,
        width=_WIDTH,
        steps=steps,
        noise=noise,
        seed=0,
    )
    added = network((base.outputs(sampled) @ metric - middle) @ axes)
    both = _with_units(base, own_shapes, sampled, added)
    return with_basis(both, both.shapes, np.zeros((len(base.controls), *base.rest.shape)), tolerance, most)


def _with_units(base: NeuralRig, own_shapes: FloatArray, values: FloatArray, added: FloatArray) -> NeuralRig:
    """The rig with shapes (q, n, 3), and units for their activations (f, q) at values (f, c)."""
    from facepipe.rig.torch.network_fit import Samples, train

    x, count = from_default(base.controls, values), len(base.shapes)
    watched = np.arange(len(x)) % 10 == 0
    parts = [Samples(inputs=x[rows], outputs=added[rows]) for rows in (~watched, watched)]
    trained = train(
        *parts, width=_UNITS, activation="silu", seed=0, steps=_STEPS, patience=_PATIENCE, sparsity=_SPARSITY
    )
    parted = (base.last[:count], base.last[count:])
    before, after = np.zeros((len(own_shapes), len(base.hidden))), np.zeros((len(base.last), _UNITS))
    last = [
        np.concatenate([parted[0], before, parted[1]]),
        np.insert(after, [count] * len(own_shapes), trained.last, axis=0),
    ]
    return replace(
        base,
        shapes=np.concatenate([base.shapes, own_shapes]),
        linear=np.concatenate([base.linear[:, :count], trained.linear, base.linear[:, count:]], axis=1),
        hidden=np.concatenate([base.hidden, trained.hidden]),
        hidden_bias=np.concatenate([base.hidden_bias, trained.hidden_bias]),
        last=np.concatenate(last, axis=1),
        last_bias=np.concatenate([base.last_bias[:count], trained.last_bias, base.last_bias[count:]]),
    )


def _coordinates(outputs: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(o,) mean of outputs (f, o), (o, i) orthonormal axes of most spread, and (i,) deviations along them."""
    middle = outputs.mean(axis=0)
    _, sizes, axes = np.linalg.svd(outputs - middle, full_matrices=False)
    deviations = sizes / np.sqrt(len(outputs))
    kept = int(np.count_nonzero(deviations[:_INPUTS] > _SMALLEST * deviations[0]))
    return middle, axes[:kept].T, deviations[:kept]
