"""The joints of a rig alone, in millimetres."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from facepipe.rig.rig import Rig

FloatArray = npt.NDArray[np.floating]


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


def coefficients_in(coefficients: FloatArray, scale: float) -> FloatArray:
    """(..., 9) bone coefficients with their translations in a unit `scale` times as small."""
    return np.asarray(coefficients * np.array([scale] * 3 + [1.0] * 6))
