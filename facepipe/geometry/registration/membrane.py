"""What holds the residual of a surface, and the system that tells it from what scans pull at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray
from facepipe.geometry.differences import cotangent_weights, incidence
from facepipe.geometry.elimination import Elimination
from facepipe.geometry.point_factor import PointFactor
from facepipe.geometry.registration.surface import DeformableSurface

if TYPE_CHECKING:
    from facepipe.geometry.registration.step import Pull


@dataclass(frozen=True, kw_only=True)
class Membrane:
    """A residual's own stiffness, and how systems of it with pulls on top are solved."""

    stiffness: Any  # (n, n) sparse, the same for each axis
    elimination: Elimination

    @classmethod
    def of(cls, surface: DeformableSurface, areas: FloatArray, stiffness: float, spreads: Sequence[Any]) -> Membrane:
        """A membrane on the base, at rest where nothing pulls.

        :param areas: (n,) of the points, mm^2
        :param spreads: (l, n) sparse of all pulls to come (`Pull.spread`)
        """
        from scipy.sparse import diags_array

        pairs, weights = cotangent_weights(surface.base, surface.triangles)
        differences = incidence(pairs, len(surface.base))
        resting = np.maximum(surface.held * areas, 1e-4 * max(float(areas.mean()), np.finfo(np.float64).tiny))
        bending = stiffness * (differences.T @ diags_array(weights) @ differences)
        links = [pairs, *(pairs_of(spread) for spread in spreads)]
        return cls(
            stiffness=bending + diags_array(resting),
            elimination=Elimination.of(surface.base, np.concatenate(links)),
        )

    def factor(self, pulls: Sequence[Pull]) -> PointFactor:
        """Of the system (3n, 3n) of the residual, axes of a point side by side."""
        from scipy.sparse import diags_array

        shared, blocks = self.stiffness, np.zeros((self.stiffness.shape[0], 3, 3))
        for pull in pulls:
            normals = pull.matches.normals
            blocks[pull.seen] += pull.weights[:, None, None] * normals[:, :, None] * normals[:, None, :]
            shared = shared + pull.spread.T @ diags_array(pull.anchor_weights) @ pull.spread
        return PointFactor(self.elimination, shared, blocks)


def pairs_of(spread: Any) -> npt.NDArray[np.integer]:
    """(p, 2) points that are in the same anchor."""
    rows, columns = (abs(spread).T @ abs(spread)).nonzero()
    return np.stack([rows, columns], axis=1)
