"""What holds the residual of a surface, and the system that tells it from what scans pull at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.geometry.block_system import sparse_blocks
from facepipe.geometry.differences import cotangent_weights, incidence
from facepipe.geometry.factor import Factor, factorise
from facepipe.geometry.registration.surface import DeformableSurface

if TYPE_CHECKING:
    from facepipe.geometry.registration.step import Pull


@dataclass(frozen=True, kw_only=True)
class Membrane:
    """A residual's own stiffness, and how systems of it with pulls on top are solved."""

    stiffness: Any  # (n, n) sparse, the same for each axis

    @classmethod
    def of(cls, surface: DeformableSurface, areas: FloatArray, stiffness: float) -> Membrane:
        """A membrane on the base, at rest where nothing pulls.

        :param areas: (n,) of the points, mm^2
        """
        from scipy.sparse import diags_array

        pairs, weights = cotangent_weights(surface.base, surface.triangles)
        differences = incidence(pairs, len(surface.base))
        resting = np.maximum(surface.held * areas, 1e-4 * max(float(areas.mean()), np.finfo(np.float64).tiny))
        bending = stiffness * (differences.T @ diags_array(weights) @ differences)
        return cls(stiffness=bending + diags_array(resting))

    def factor(self, pulls: Sequence[Pull]) -> Factor:
        """Of the system (3n, 3n) of the residual, axes of a point side by side."""
        from scipy.sparse import diags_array

        shared, blocks = self.stiffness, np.zeros((self.stiffness.shape[0], 3, 3))
        for pull in pulls:
            normals = pull.matches.normals
            blocks[pull.seen] += pull.weights[:, None, None] * normals[:, :, None] * normals[:, None, :]
            shared = shared + pull.spread.T @ diags_array(pull.anchor_weights) @ pull.spread
        return factorise(sparse_blocks(blocks, shared))
