"""Light as spherical harmonics up to the second order: nine numbers a colour (Ramamoorthi and Hanrahan 2001)."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray


def harmonics(normals: FloatArray) -> FloatArray:
    """(..., 9) real spherical harmonics of unit vectors (..., 3): 1, y, z, x, xy, yz, 3 z^2 - 1, zx, x^2 - y^2."""
    x, y, z = np.moveaxis(np.asarray(normals), -1, 0)
    zeroth, first, second = np.sqrt(1 / (4 * np.pi)), np.sqrt(3 / (4 * np.pi)), np.sqrt(15 / (4 * np.pi))
    rows = [
        np.full_like(x, zeroth),
        first * y,
        first * z,
        first * x,
        second * x * y,
        second * y * z,
        second / np.sqrt(12) * (3 * z * z - 1),
        second * z * x,
        second / 2 * (x * x - y * y),
    ]
    return np.stack(rows, axis=-1)
