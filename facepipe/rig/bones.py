"""The joints of a rig alone, in millimetres."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.rig.rig import Rig


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
