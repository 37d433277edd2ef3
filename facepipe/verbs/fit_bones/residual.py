"""What bones can't reach as sparse corrective blendshapes, over poses that SkelAnimation holds as they are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray
from facepipe.core.threads import one_thread
from facepipe.parts import Blendshape, FaceParts
from facepipe.rig import Rig, mesh_spaces, rest_coefficients
from facepipe.rig.trs import decompose
from facepipe.verbs.fit_bones.bone_fit import BoneFit

_FLAT = 1e-9  # determinant of a blended matrix, of its size: no way back from there
_SAME = 2e-7  # relative: a scale that is as near to one in half precision is it


@dataclass(frozen=True)
class Residual:
    """Offsets of points before skinning, in float32 as they are authored."""

    shapes: tuple[Blendshape | None, ...]  # per mesh; None where no point of it is corrected
    points: FloatArray  # (n, 3) world points with bones and offsets
    lost: int  # points whose skinning can't be turned round


def corrective(
    parts: FaceParts,
    rig: Rig,
    name: str,
    coefficients: FloatArray,
    target: FloatArray,
    corrected: BoolArray,
) -> Residual:
    """The blendshape that brings the posed points `corrected` (n,) to `target` (n, 3), and leaves the others.

    Blendshapes come before skinning: the difference in the world goes back through each point's blended matrix.

    :param parts: what `rig` was built from
    :param coefficients: (m, 9) of the pose
    """
    matrices = rig.skinning_matrices(rig.local_transforms(coefficients))
    posed = rig.skin(rig.points, matrices)
    blended = (rig.influences @ matrices[:, :3, :3].reshape(-1, 9)).reshape(-1, 3, 3)
    # det grows with the cube of the norm: their ratio says how flat a matrix is, whatever the scale of its joints;
    # the inverse of a flat one would throw its point far off
    sizes = np.linalg.norm(blended, axis=(1, 2)) ** 3
    kept = corrected & (np.abs(np.linalg.det(blended)) > _FLAT * sizes)
    rows = np.flatnonzero(kept)
    moved = np.linalg.solve(blended[rows], (target - posed)[rows, :, None])[..., 0]
    shapes: list[Blendshape | None] = []
    bound = rig.points.copy()
    for number, space in enumerate(mesh_spaces(parts)):
        start, stop = rig.mesh_offsets[number : number + 2]
        inside = slice(*np.searchsorted(rows, [start, stop]))
        linear = np.asarray(space, np.float64)[:3, :3]
        offsets = np.linalg.solve(linear, moved[inside].T).T.astype(np.float32)
        # the offsets as rounded to float32: the points returned are those that the file gives
        bound[rows[inside]] += offsets.astype(np.float64) @ linear.T
        indices = (rows[inside] - start).astype(np.int32)
        shapes.append(Blendshape(name=name, point_indices=indices, offsets=offsets) if len(indices) else None)
    return Residual(tuple(shapes), rig.skin(bound, matrices), int(corrected.sum() - kept.sum()))


def half_scaled(fit: BoneFit, coefficients: FloatArray, target: FloatArray) -> FloatArray:
    """(m, 9) float32 numbers near `coefficients`, with scales that SkelAnimation, which is half precision, holds.

    Scales are rounded; the other coefficients then make good what that does to the points. In a sparse fit those that
    rest go on to rest.

    :param target: (n, 3)
    """
    held = np.zeros(coefficients.shape, dtype=np.bool_)
    held[:, 6:] = True
    if fit.sparsity > 0:
        held |= coefficients == rest_coefficients(len(coefficients))
    rounded = _rounded(fit, coefficients)
    with one_thread():
        return _rounded(fit, fit.refit(target, rounded, held).coefficients)


def _rounded(fit: BoneFit, coefficients: FloatArray) -> FloatArray:
    """(m, 9) as float32 numbers with scales of half precision, tied ones alike."""
    rounded = with_half_scales(fit.rig, coefficients, fit.lower, fit.upper)
    if fit.symmetry is not None:
        rounded[:, 6:] = rounded.ravel()[fit.symmetry.leaders].reshape(rounded.shape)[:, 6:]
    return rounded.astype(np.float32).astype(np.float64)


def with_half_scales(rig: Rig, coefficients: FloatArray, lower: FloatArray, upper: FloatArray) -> FloatArray:
    """(m, 9) `coefficients` with each scale the nearest that makes that of the local transform half precision.

    Where limits (m, 9) leave no such scale beside a coefficient, and where a transform has shear, it stays as it is.
    """
    rounded = np.array(coefficients, dtype=np.float64)
    rounded[:, 6:] = _nearest(rounded[:, 6:], _factors(rig, rounded), lower[:, 6:], upper[:, 6:])
    return rounded


def _factors(rig: Rig, coefficients: FloatArray) -> FloatArray:
    """(m, 3) scales of the local transforms, by those of the coefficients; NaN where there are none."""
    local = decompose(rig.local_transforms(coefficients))
    with np.errstate(divide="ignore", invalid="ignore"):
        factors = local.scale / coefficients[:, 6:]
    return np.where(local.sheared[:, None] | (factors == 0) | ~np.isfinite(factors), np.nan, factors)


def _nearest(values: FloatArray, factors: FloatArray, lower: FloatArray, upper: FloatArray) -> FloatArray:
    """Values, one by one the nearest inside the limits whose products with `factors` are half precision."""
    products = values * factors
    with np.errstate(over="ignore"):
        half = products.astype(np.float16)
        candidates = (half, np.nextafter(half, np.float16(np.inf)), np.nextafter(half, np.float16(-np.inf)))
    done = ~np.isfinite(half) | (np.abs(half.astype(np.float64) - products) <= _SAME * np.abs(products))
    rounded = np.array(values, dtype=np.float64)
    for candidate in candidates:
        tried = (candidate.astype(np.float64) / factors).astype(np.float32).astype(np.float64)
        fits = ~done & (lower <= tried) & (tried <= upper)
        rounded = np.where(fits, tried, rounded)
        done = done | fits
    return rounded
