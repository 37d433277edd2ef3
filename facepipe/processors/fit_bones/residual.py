"""What bones can't reach as sparse corrective blendshapes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray
from facepipe.parts import Blendshape, FaceParts
from facepipe.rig import Rig, mesh_spaces

_FLAT = 1e-9  # determinant of a blended matrix, of its size: no way back from there


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
    corrected: npt.NDArray[np.bool_],
) -> Residual:
    """The blendshape that brings the posed points `corrected` (n,) to `target` (n, 3), and leaves the others.

    Blendshapes come before skinning: the difference in the world goes back through each point's blended matrix.

    :param parts: what `rig` was built from
    :param coefficients: (m, 9) of the pose
    """
    matrices = rig.skinning_matrices(rig.local_transforms(coefficients))
    posed = rig.skin(rig.points, matrices)
    blended = (rig.influences @ matrices[:, :3, :3].reshape(-1, 9)).reshape(-1, 3, 3)
    sizes = np.linalg.norm(blended, axis=(1, 2)) ** 3
    kept = corrected & (np.abs(np.linalg.det(blended)) > _FLAT * sizes)
    rows = np.flatnonzero(kept)
    moved = np.linalg.solve(blended[rows], (target - posed)[rows, :, None])[..., 0]
    shapes: list[Blendshape | None] = []
    bound = rig.points.copy()
    for number, space in enumerate(mesh_spaces(parts)):
        start, stop = rig.mesh_offsets[number : number + 2]
        inside = slice(*np.searchsorted(rows, [start, stop]))
        own = np.linalg.solve(np.asarray(space, np.float64)[:3, :3], moved[inside].T).T.astype(np.float32)
        bound[rows[inside]] += own.astype(np.float64) @ np.asarray(space, np.float64)[:3, :3].T
        indices = (rows[inside] - start).astype(np.int32)
        shapes.append(Blendshape(name=name, point_indices=indices, offsets=own) if len(indices) else None)
    return Residual(tuple(shapes), rig.skin(bound, matrices), int(corrected.sum() - kept.sum()))
