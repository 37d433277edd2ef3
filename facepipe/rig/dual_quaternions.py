"""Skinning by dual quaternions, which keeps volume where joints twist.

L. Kavan, S. Collins, J. Zara, C. O'Sullivan, "Skinning with Dual Quaternions" (2007), with scale and shear of each
joint apart, before the rigid motion, as UsdSkel has it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.rig.trs import decompose, rotation_matrices

if TYPE_CHECKING:
    from scipy import sparse


def dual_quaternion_blend(influences: sparse.csr_array, matrices: FloatArray) -> FloatArray:
    """(n, 3, 4) transforms of points with (n, j) weights that sum to 1 under (j, 4, 4) affine matrices.

    Each matrix is a stretch K and then a rigid motion, as unit quaternion q and dual part ``d = (0, t) q / 2``. Points
    take ``q = sum +-w q_j / |sum +-w q_j|``, d by the same sum and length, and ``sum w K_j``; the translation is the
    vector part of ``2 d conj(q)``.
    """
    from scipy import sparse

    # (j, 3, 3) symmetric stretches, negative where a matrix mirrors, and the (j, 4, 4) rigid motions after them
    linear = matrices[:, :3, :3]
    U, _, Vt = np.linalg.svd(linear)
    rotation = U @ Vt
    rotation *= np.where(np.linalg.det(rotation) < 0, -1.0, 1.0)[:, None, None]
    rigid = np.array(matrices)
    rigid[:, :3, :3] = rotation
    stretch, turned = np.swapaxes(rotation, 1, 2) @ linear, rigid
    real = decompose(turned).rotation  # (j, 4) x y z w
    dual = 0.5 * _product(np.pad(turned[:, :3, 3], ((0, 0), (0, 1))), real)
    # the weights, negative where a joint's quaternion lies on the other side than that of the largest weight
    rows = np.repeat(np.arange(influences.shape[0]), np.diff(influences.indptr))
    order = np.lexsort((influences.indices, -influences.data, rows))
    first = order[np.concatenate([[True], rows[order][1:] != rows[order][:-1]])] if len(order) else order
    pivot = np.zeros(influences.shape[0], np.int64)
    pivot[rows[first]] = influences.indices[first]
    opposite = np.einsum("ij,ij->i", real[influences.indices], real[pivot[rows]]) < 0
    data = np.where(opposite, -influences.data, influences.data)
    signed = sparse.csr_array((data, influences.indices, influences.indptr), shape=influences.shape)
    length = np.linalg.norm(signed @ real, axis=1)[:, None]
    length[length == 0] = 1.0
    real, dual = (signed @ real) / length, (signed @ dual) / length
    blended = np.empty((influences.shape[0], 3, 4))
    blended[..., :3] = rotation_matrices(real) @ (influences @ stretch.reshape(-1, 9)).reshape(-1, 3, 3)
    blended[..., 3] = 2.0 * _product(dual, real * (-1.0, -1.0, -1.0, 1.0))[:, :3]
    return blended


def _product(a: FloatArray, b: FloatArray) -> FloatArray:
    """(n, 4) products of quaternions x y z w."""
    ax, ay, az, aw = np.moveaxis(a, -1, 0)
    bx, by, bz, bw = np.moveaxis(b, -1, 0)
    return np.stack(
        [
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        ],
        axis=-1,
    )
