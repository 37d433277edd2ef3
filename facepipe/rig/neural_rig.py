"""What a learned rig makes of its controls: points as a sum of learned shapes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from facepipe.errors import InputError

FloatArray = npt.NDArray[np.floating]


@dataclass(frozen=True, kw_only=True)
class Control:
    """One rig parameter, in its own unit."""

    name: str
    minimum: float = 0.0
    maximum: float = 1.0
    default: float = 0.0


@dataclass(frozen=True, kw_only=True)
class NeuralRig:
    """``points = rest + sum_r a_r shape_r``, where the activations ``a = x linear + last tanh(hidden x + hidden_bias)
    + last_bias``, and x are the c controls, clamped to their limits, from -1 to 1.

    The straight part of a rig is in `linear`; the layer of h units adds what is not straight. Shapes are orthonormal.
    """

    controls: tuple[Control, ...]
    rest: FloatArray  # (n, 3) millimetres, Y up
    shapes: FloatArray  # (r, n, 3)
    linear: FloatArray  # (c, r) millimetres
    hidden: FloatArray  # (h, c)
    hidden_bias: FloatArray  # (h,)
    last: FloatArray  # (r, h) millimetres
    last_bias: FloatArray  # (r,) millimetres
    topology: str  # digest of the meshes that it was learned on

    def values(self, settings: Mapping[str, float]) -> FloatArray:
        """(c,) values by name; controls that are not named keep their defaults.

        :raises InputError: a name of no control, or a value that is not finite
        """
        found = {control.name: control.default for control in self.controls}
        for name, value in settings.items():
            if name not in found:
                some = ", ".join(list(found)[:6])
                raise InputError("neural rig", f"no control '{name}', expected some of {some}")
            if not np.isfinite(value):
                raise InputError(f"neural rig -> {name}", f"value {value}, expected a finite number")
            found[name] = value
        return np.array(list(found.values()))

    def activations(self, values: FloatArray) -> FloatArray:
        """(..., r) millimetres of (..., c) values."""
        x = inputs(self.controls, values)
        bent = np.tanh(x @ self.hidden.T + self.hidden_bias) @ self.last.T
        return np.asarray(x @ self.linear + bent + self.last_bias)

    def points(self, values: FloatArray) -> FloatArray:
        """(..., n, 3) millimetres of (..., c) values."""
        return np.asarray(self.rest + np.tensordot(self.activations(values), self.shapes, axes=1))


def inputs(controls: tuple[Control, ...], values: FloatArray) -> FloatArray:
    """(..., c) from -1 to 1: values (..., c) over their controls' ranges, clamped to them."""
    low, high = (np.array([getattr(one, key) for one in controls]) for key in ("minimum", "maximum"))
    return np.asarray(2.0 * (np.clip(values, low, high) - low) / (high - low) - 1.0)
