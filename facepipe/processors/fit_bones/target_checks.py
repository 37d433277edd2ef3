"""Whether targets are of the face that is to reach them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.processors.fit_bones.targets import Target

_FARTHEST = 1000.0  # sizes of the face: no pose, and beyond what its numbers stand for
_OTHER_SIZE = 4.0  # times as large, or as small: perhaps other units


def check_targets(targets: Sequence[Target], rest: FloatArray, weights: FloatArray) -> None:
    """Check targets against the (n, 3) points of the face at rest, of which those with a weight (n,) count.

    :raises InputError: no target, another number of points, no point that counts, or points far from any pose
    """
    if not targets:
        raise InputError("targets", "none given, expected at least one")
    for target in targets:
        if target.points.shape[1] != len(rest):
            raise InputError(f"target {target.name}", f"{target.points.shape[1]:,} points, expected {len(rest):,}")
        counts = _counting(target, weights)
        if not counts.any():
            raise InputError(f"target {target.name}", "knows no point that counts")
        size = float(np.ptp(rest[counts], axis=0).max())
        farthest = float(np.abs(target.points[:, counts] - rest[counts].mean(axis=0)).max())
        if size > 0 and farthest > _FARTHEST * size:
            what = f"points {farthest / size:.3g} times the face's size away, expected less than {_FARTHEST:g}"
            raise InputError(f"target {target.name}", f"{what}: are its units right?")


def size_warning(target: Target, name: str, rest: FloatArray, weights: FloatArray) -> list[str]:
    """A line where a target is so much larger or smaller than the face that its units may be others."""
    counts = _counting(target, weights)
    size, sizes = np.ptp(rest[counts], axis=0).max(), np.ptp(target.points[:, counts], axis=1).max(axis=1)
    ratios = sizes / size if size > 0 else np.ones(1)
    ratio = float(ratios.max() if ratios.max() > _OTHER_SIZE else ratios.min())
    if 1 / _OTHER_SIZE <= ratio <= _OTHER_SIZE:
        return []
    return [f"{name}: is {ratio:.3g} times as large as the face: are its units right?"]


def _counting(target: Target, weights: FloatArray) -> npt.NDArray[np.bool_]:
    counts: npt.NDArray[np.bool_] = weights > 0
    return counts if target.known is None else counts & target.known
