"""Places on a surface whose counterparts on the scan are known: landmarks and painted markers."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.floating]
IntArray = npt.NDArray[np.integer]


@dataclass(frozen=True, kw_only=True)
class Anchors:
    """l places, each on a triangle (or a point, with share 1), with where the scan has them."""

    corners: IntArray  # (l, 3) points of the surface
    shares: FloatArray  # (l, 3) in sum 1
    targets: FloatArray  # (l, 3) on the scan
    names: tuple[str, ...] = field(default=())  # one each, for reports

    @classmethod
    def at_points(cls, points: IntArray, targets: FloatArray, names: tuple[str, ...] = ()) -> Anchors:
        """Anchors at points (l,) of the surface; rows of NaN in `targets` (l, 3) are left out."""
        known = np.flatnonzero(np.isfinite(targets).all(axis=1))
        shares = np.tile([1.0, 0.0, 0.0], (len(known), 1))
        corners = np.repeat(np.asarray(points)[known, None], 3, axis=1)
        kept = tuple(names[i] for i in known) if names else ()
        return cls(corners=corners, shares=shares, targets=np.asarray(targets, np.float64)[known], names=kept)

    def __len__(self) -> int:
        return len(self.targets)

    def places(self, values: FloatArray) -> FloatArray:
        """(l, ...) values (n, ...) of the surface's points at the anchors."""
        return np.asarray(np.einsum("lc,lc...->l...", self.shares, values[self.corners]))

    def matrix(self, count: int) -> Any:
        """(l, count) sparse: values of points to values at the anchors."""
        from scipy.sparse import csr_array

        rows = np.repeat(np.arange(len(self)), 3)
        return csr_array((self.shares.ravel(), (rows, self.corners.ravel())), shape=(len(self), count))

    def with_more(self, other: Anchors) -> Anchors:
        """These and others."""
        return Anchors(
            corners=np.concatenate([self.corners, other.corners]),
            shares=np.concatenate([self.shares, other.shares]),
            targets=np.concatenate([self.targets, other.targets]),
            names=self.names + other.names,
        )
