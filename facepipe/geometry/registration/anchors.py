"""Places on a surface whose counterparts on the scan are known: landmarks and painted markers."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray


def no_sigmas() -> FloatArray:
    """All have the sigma of the options."""
    return np.zeros(0)


@dataclass(frozen=True, kw_only=True)
class Anchors:
    """l places, each on a triangle (or a point, with share 1), with where the scan has them."""

    corners: IntArray  # (l, 3) points of the surface
    shares: FloatArray  # (l, 3) in sum 1
    targets: FloatArray  # (l, 3) on the scan
    names: tuple[str, ...] = field(default=())  # one each, for reports
    sigmas: FloatArray = field(default_factory=no_sigmas)  # (l,) mm or none; NaN: that of the options

    @classmethod
    def at_points(
        cls, points: IntArray, targets: FloatArray, names: tuple[str, ...] = (), sigmas: FloatArray | None = None
    ) -> Anchors:
        """Anchors at points (l,) of the surface; rows of NaN in `targets` (l, 3) are left out."""
        known = np.flatnonzero(np.isfinite(targets).all(axis=1))
        shares = np.tile([1.0, 0.0, 0.0], (len(known), 1))
        corners = np.repeat(np.asarray(points)[known, None], 3, axis=1)
        kept = tuple(names[i] for i in known) if names else ()
        own = no_sigmas() if sigmas is None else np.asarray(sigmas, np.float64)[known]
        targets = np.asarray(targets, np.float64)[known]
        return cls(corners=corners, shares=shares, targets=targets, names=kept, sigmas=own)

    def __len__(self) -> int:
        return len(self.targets)

    def variances(self, sigma: float) -> FloatArray:
        """(l,) mm^2, where those without a sigma of their own have `sigma`."""
        found = np.full(len(self), sigma**2)
        if len(self.sigmas):
            own = np.isfinite(self.sigmas)
            found[own] = self.sigmas[own] ** 2
        return found

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
            sigmas=np.concatenate(
                [one.sigmas if len(one.sigmas) else np.full(len(one), np.nan) for one in (self, other)]
            ),
        )
