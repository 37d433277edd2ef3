"""A learned rig: from controls to bone coefficients, and to points as a sum of learned shapes."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import expit

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.core.names import unknown
from facepipe.geometry.shape_basis import motion_basis
from facepipe.rig.bone_coefficients import rest_coefficients
from facepipe.rig.rig import Rig

_ORTHONORMAL_ERROR = 1e-5  # what float32 files may take from it
_RANDOM_PROBES = 512  # random values of all controls, and as many corners


@dataclass(frozen=True, kw_only=True)
class Control:
    """One rig parameter, in its own unit."""

    name: str
    minimum: float = 0.0
    maximum: float = 1.0
    default: float = 0.0


@dataclass(frozen=True, kw_only=True)
class NeuralRig:
    """``outputs = x linear + last silu(hidden x + hidden_bias) + last_bias`` of the c controls: first r activations of
    shapes, then m bone coefficients, as far as they are from rest. x is how far controls, clamped to their limits, are
    from their defaults, in shares of their ranges.

    ``points = skin(rest + sum_r a_r shape_r)``, where the bones skin; without them the sum is the points. The straight
    part of a rig is in `linear`; the layer of h units adds what is not straight. Shapes are orthonormal.
    """

    controls: tuple[Control, ...]
    rest: FloatArray  # (n, 3) millimetres: with bones in skeleton space at bind time, otherwise in the world, Y up
    shapes: FloatArray  # (r, n, 3)
    linear: FloatArray  # (c, r + m) millimetres, radians, scales
    hidden: FloatArray  # (h, c)
    hidden_bias: FloatArray  # (h,)
    last: FloatArray  # (r + m, h)
    last_bias: FloatArray  # (r + m,)
    topology: str  # digest of the meshes that it was learned on
    bones: Rig | None = None  # in millimetres, without shapes
    channels: IntArray = field(default_factory=lambda: np.zeros((0, 2), np.int64))  # (m, 2) joint, coefficient 0..8

    def values(self, settings: Mapping[str, float]) -> FloatArray:
        """(c,) values by name; controls that are not named keep their defaults.

        :raises InputError: a name of no control, or a value that is not finite
        """
        values = {control.name: control.default for control in self.controls}
        for name, value in settings.items():
            if name not in values:
                raise InputError("neural rig", unknown(name, values, "control"))
            if not np.isfinite(value):
                raise InputError(f"neural rig -> {name}", f"value {value}, expected a finite number")
            values[name] = value
        return np.array(list(values.values()))

    def outputs(self, values: FloatArray) -> FloatArray:
        """(..., r + m) of (..., c) values: activations in millimetres, then bone coefficients from rest."""
        x = from_default(self.controls, values)
        units = x @ self.hidden.T + self.hidden_bias
        return np.asarray(x @ self.linear + (units * expit(units)) @ self.last.T + self.last_bias)

    def activations(self, values: FloatArray) -> FloatArray:
        """(..., r) millimetres of (..., c) values."""
        return self.outputs(values)[..., : len(self.shapes)]

    def coefficients(self, outputs: FloatArray) -> FloatArray:
        """(..., j, 9) bone coefficients of (..., r + m) outputs; translations in millimetres."""
        joints = 0 if self.bones is None else len(self.bones.joints)
        found = np.tile(rest_coefficients(joints), (*outputs.shape[:-1], 1, 1))
        found[..., self.channels[:, 0], self.channels[:, 1]] += outputs[..., len(self.shapes) :]
        return np.asarray(found)

    def morphed(self, outputs: FloatArray) -> FloatArray:
        """(..., n, 3) points before the bones move them, of (..., r + m) outputs."""
        return np.asarray(self.rest + np.tensordot(outputs[..., : len(self.shapes)], self.shapes, axes=1))

    def deformed(self, outputs: FloatArray) -> FloatArray:
        """(..., n, 3) millimetres, Y up, of (..., r + m) outputs."""
        flat, bones = outputs.reshape(-1, outputs.shape[-1]), self.bones
        frames = self.morphed(flat)
        if bones is not None:
            local = map(bones.local_transforms, self.coefficients(flat))
            for points, transforms in zip(frames, local, strict=True):
                points[:] = bones.skin(points, bones.skinning_matrices(transforms))
        return frames.reshape(*outputs.shape[:-1], *self.rest.shape)

    def points(self, values: FloatArray) -> FloatArray:
        """(..., n, 3) millimetres of (..., c) values."""
        return self.deformed(self.outputs(np.asarray(values, dtype=np.float64)))


def from_default(controls: tuple[Control, ...], values: FloatArray) -> FloatArray:
    """(..., c) shares of their ranges that values (..., c), clamped to them, are from their controls' defaults."""
    low, high, rest = _ranges(controls)
    return np.asarray((np.clip(values, low, high) - rest) / (high - low))


def inputs(controls: tuple[Control, ...], values: FloatArray) -> FloatArray:
    """(..., c) from -1 to 1: values (..., c) over their controls' ranges, clamped to them."""
    low, high, _ = _ranges(controls)
    return np.asarray(2.0 * (np.clip(values, low, high) - low) / (high - low) - 1.0)


def share_limits(controls: Sequence[Control]) -> tuple[FloatArray, FloatArray]:
    """(c,) lowest shares, 0 or less, and (c,) highest, 0 or more."""
    low, high, rest = _ranges(controls)
    return (low - rest) / (high - low), (high - rest) / (high - low)


def values_of(controls: Sequence[Control], x: FloatArray) -> FloatArray:
    """(..., c) values, within limits, of (..., c) shares: the inverse of `from_default`."""
    low, high, rest = _ranges(controls)
    return np.asarray(np.clip(rest + x * (high - low), low, high))


def _ranges(controls: Sequence[Control]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(c,) minima, maxima and defaults."""
    rows = np.array(
        [(control.minimum, control.maximum, control.default) for control in controls], dtype=np.float64
    ).reshape(-1, 3)
    return rows[:, 0], rows[:, 1], rows[:, 2]


def with_orthonormal_shapes(rig: NeuralRig) -> NeuralRig:
    """The same rig by shapes whose activations are as far apart as the points that they make."""
    flat = rig.shapes.reshape(len(rig.shapes), -1)
    if np.allclose(flat @ flat.T, np.eye(len(flat)), atol=_ORTHONORMAL_ERROR):
        return rig
    return with_basis(rig, rig.shapes, np.zeros((len(rig.controls), *rig.rest.shape)), 0.0, len(rig.shapes))


def with_basis(rig: NeuralRig, shapes: FloatArray, by_control: FloatArray, tolerance: float, most: int) -> NeuralRig:
    """The rig with other shapes for its activations, and shapes that its controls bring, over an orthonormal basis.

    :param shapes: (r, n, 3) in place of the rig's own
    :param by_control: (c, n, 3) of a control its whole range from its default
    :param tolerance: millimetres that the basis may leave of any of these at its largest, RMS
    :param most: shapes of the basis
    """
    count = len(shapes)
    sizes = np.concatenate([output_reach(rig)[:count], np.ones(len(by_control))])
    rows = np.concatenate([shapes, by_control])
    # each row as large as it gets: of rows as they are, the basis would hold shapes best that hardly come on
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


def output_reach(rig: NeuralRig) -> FloatArray:
    """(r + m,) how far each output goes: each control at its limits alone, all at random, all at random limits."""
    low, high, rest = _ranges(rig.controls)
    shares = np.random.default_rng(0).random((2 * _RANDOM_PROBES, len(rest)))
    shares[_RANDOM_PROBES:] = shares[_RANDOM_PROBES:] < 0.5
    alone = np.repeat(rest[None], 2 * len(rest), axis=0)
    each = np.arange(len(rest))
    alone[each, each], alone[len(rest) + each, each] = low, high
    found = np.abs(rig.outputs(np.concatenate([alone, low + shares * (high - low)]))).max(axis=0)
    return np.asarray(np.maximum(found, np.finfo(np.float32).eps))


def bones_in(rig: Rig, to: FloatArray) -> Rig:
    """The rig without its shapes, in another unit and world: points and joints scaled, skeleton space turned.

    :param to: (4, 4) from the rig's world to the other one, without shear
    :raises InputError: points skinned by dual quaternions
    """
    rig.require_linear("a neural rig")
    scale = float(np.cbrt(abs(np.linalg.det(to[:3, :3]))))
    larger, smaller = np.diag([scale] * 3 + [1.0]), np.diag([1.0 / scale] * 3 + [1.0])
    return replace(
        rig,
        points=rig.points * scale,
        shapes=(),
        targets=(),
        rest=larger @ rig.rest @ smaller,
        inverse_bind=larger @ rig.inverse_bind @ smaller,
        parent_world=to @ rig.parent_world @ smaller,
    )


def most_influences(rig: Rig) -> int:
    """The number of joints that move the point that most move."""
    return int(np.diff(rig.influences.indptr).max(initial=0))


def with_influences(rig: Rig, most: int) -> Rig:
    """The rig with the largest `most` weights of every point, renormalised."""
    if most_influences(rig) <= most:
        return rig
    kept = rig.influences.copy()
    for start, end in itertools.pairwise(kept.indptr.tolist()):
        if end - start > most:
            weights = kept.data[start:end]
            weights[np.argsort(-weights, kind="stable")[most:]] = 0.0
            weights /= weights.sum()
    kept.eliminate_zeros()
    return replace(rig, influences=kept)


def coefficients_in(coefficients: FloatArray, scale: float) -> FloatArray:
    """(..., 9) bone coefficients with their translations in a unit `scale` times as small."""
    return np.asarray(coefficients * np.array([scale] * 3 + [1.0] * 6))
