"""What a learned rig makes of its controls: bone coefficients, and points as a sum of learned shapes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.special import expit

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.core.names import unknown
from facepipe.rig.bone_coefficients import rest_coefficients
from facepipe.rig.rig import Rig


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
        found = {control.name: control.default for control in self.controls}
        for name, value in settings.items():
            if name not in found:
                raise InputError("neural rig", unknown(name, found, "control"))
            if not np.isfinite(value):
                raise InputError(f"neural rig -> {name}", f"value {value}, expected a finite number")
            found[name] = value
        return np.array(list(found.values()))

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
            for points, own in zip(frames, local, strict=True):
                points[:] = bones.skin(points, bones.skinning_matrices(own))
        return frames.reshape(*outputs.shape[:-1], *self.rest.shape)

    def points(self, values: FloatArray) -> FloatArray:
        """(..., n, 3) millimetres of (..., c) values."""
        return self.deformed(self.outputs(np.asarray(values, dtype=np.float64)))


def from_default(controls: tuple[Control, ...], values: FloatArray) -> FloatArray:
    """(..., c) shares of their ranges that values (..., c), clamped to them, are from their controls' defaults."""
    low, high, rest = (np.array([getattr(one, key) for one in controls]) for key in ("minimum", "maximum", "default"))
    return np.asarray((np.clip(values, low, high) - rest) / (high - low))


def inputs(controls: tuple[Control, ...], values: FloatArray) -> FloatArray:
    """(..., c) from -1 to 1: values (..., c) over their controls' ranges, clamped to them."""
    low, high = (np.array([getattr(one, key) for one in controls]) for key in ("minimum", "maximum"))
    return np.asarray(2.0 * (np.clip(values, low, high) - low) / (high - low) - 1.0)
