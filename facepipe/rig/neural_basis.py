"""Neural rigs over an orthonormal basis of shapes, and how far their outputs go."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.geometry.motion_basis import motion_basis
from facepipe.rig.neural_rig import NeuralRig

_ORTHONORMAL = 1e-5  # what float32 files may take from it
_PROBES = 512  # random values of all controls, and as many corners


def with_orthonormal_shapes(rig: NeuralRig) -> NeuralRig:
    """The same rig by shapes whose activations are as far apart as the points that they make."""
    flat = rig.shapes.reshape(len(rig.shapes), -1)
    if np.allclose(flat @ flat.T, np.eye(len(flat)), atol=_ORTHONORMAL):
        return rig
    return over(rig, rig.shapes, np.zeros((len(rig.controls), *rig.rest.shape)), 0.0, len(rig.shapes))


def over(rig: NeuralRig, shapes: FloatArray, by_control: FloatArray, tolerance: float, most: int) -> NeuralRig:
    """The rig with other shapes for its activations, and shapes that its controls bring, over an orthonormal basis.

    :param shapes: (r, n, 3) in place of the rig's own
    :param by_control: (c, n, 3) of a control its whole range from its default
    :param tolerance: millimetres that the basis may leave of any of these at its largest, RMS
    :param most: shapes of the basis
    """
    count = len(shapes)
    sizes = np.concatenate([reach(rig)[:count], np.ones(len(by_control))])
    rows = np.concatenate([shapes, by_control])
    basis, amounts = motion_basis(rows * sizes[:, None, None], tolerance, most)
    amounts = amounts / sizes[:, None]
    to_new, to_controls = amounts[:count], amounts[count:]
    return replace(
        rig,
        shapes=basis,
        linear=np.concatenate([rig.linear[:, :count] @ to_new + to_controls, rig.linear[:, count:]], axis=1),
        last=np.concatenate([to_new.T @ rig.last[:count], rig.last[count:]]),
        last_bias=np.concatenate([rig.last_bias[:count] @ to_new, rig.last_bias[count:]]),
    )


def reach(rig: NeuralRig) -> FloatArray:
    """(r + m,) how far each output goes: each control at its limits alone, all at random, all at random limits."""
    low, high, rest = (
        np.array([getattr(one, key) for one in rig.controls]) for key in ("minimum", "maximum", "default")
    )
    shares = np.random.default_rng(0).random((2 * _PROBES, len(rest)))
    shares[_PROBES:] = shares[_PROBES:] < 0.5
    alone = np.repeat(rest[None], 2 * len(rest), axis=0)
    each = np.arange(len(rest))
    alone[each, each], alone[len(rest) + each, each] = low, high
    found = np.abs(rig.outputs(np.concatenate([alone, low + shares * (high - low)]))).max(axis=0)
    return np.asarray(np.maximum(found, np.finfo(np.float32).eps))
