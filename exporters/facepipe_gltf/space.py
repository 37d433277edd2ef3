"""From stage space to glTF space: metres, Y up."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from facepipe.parts import FaceParts, FloatArray
from facepipe.rig.trs import Trs, decompose, rotation_matrices

__all__ = ["Space", "Trs", "decompose", "numbers", "rotation_matrices", "space_of"]

_Z_UP_TO_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True)
class Space:
    """Where the parts of a face go.

    `world` takes stage world space to glTF space; `skeleton` takes skeleton space there. A joint's local matrix L
    becomes ``axes L inverse(axes)``, a root's ``placement axes L inverse(axes)``: `axes` holds the units, the axis
    change and the skeleton's uniform scale, so that joints carry none of them.
    """

    world: FloatArray  # (4, 4)
    skeleton: FloatArray  # (4, 4)
    axes: FloatArray  # (4, 4), linear
    placement: FloatArray  # (4, 4)

    def local(self, matrices: FloatArray, is_root: npt.NDArray[np.bool_]) -> FloatArray:
        """(..., j, 4, 4) local joint matrices of the stage, as those of glTF nodes."""
        turned = self.axes @ matrices @ np.linalg.inv(self.axes)
        turned[..., is_root, :, :] = self.placement @ turned[..., is_root, :, :]
        return np.asarray(turned)

    def inverse_binds(self, bind_transforms: FloatArray) -> FloatArray:
        """(j, 4, 4) inverse bind matrices for vertices in glTF space."""
        return np.asarray(self.axes @ np.linalg.inv(bind_transforms) @ np.linalg.inv(self.skeleton))


def space_of(parts: FaceParts) -> Space:
    """The conversion of a face; its skeleton's transform must be invertible."""
    world = np.eye(4)
    turn = _Z_UP_TO_Y_UP if parts.up_axis == "Z" else np.eye(3)
    world[:3, :3] = turn * parts.meters_per_unit
    skeleton = world @ np.asarray(parts.skeleton.transform, dtype=np.float64)
    axes = np.eye(4)
    axes[:3, :3] = turn * np.cbrt(abs(np.linalg.det(skeleton[:3, :3])))
    return Space(world, skeleton, axes, skeleton @ np.linalg.inv(axes))


def numbers(values: Any) -> list[float]:
    """float32 values as JSON numbers, shortest form."""
    return [float(str(value)) + 0.0 for value in np.asarray(values, dtype=np.float32).ravel()]
