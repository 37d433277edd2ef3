"""Lips of a head in the box by rays: the teeth between them from the front, and how far one goes into the other."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from contacts import Subject

from facepipe.geometry.contacts import Grid
from facepipe.heads.asset import asset

FloatArray = npt.NDArray[np.float64]
OVERLAP = 0.3  # mm that lips may go into one another at rest
_AROUND = 3.2  # cm from the middle of the mouth
_DROPS, _STAYS = 0.6, 0.3  # of the lower lip's way down in jawOpen: what goes farther is below, what less is above
_FROM_ABOVE = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


class Lips:
    """The lips and teeth of the average head's topology."""

    def __init__(self, average: Subject) -> None:
        self._skin, self._teeth, self._gums = (average.triangles(name) for name in ("Head", "Teeth", "GumsAndTongue"))
        drop = -asset().shapes["jawOpen"][1.0][:, 1].astype(np.float64)
        above, below = asset().landmarks[[62, 66]]
        near = np.linalg.norm(asset().points[self._skin].mean(axis=1) - asset().points[above], axis=1) < _AROUND
        near &= (self._skin < asset().parts["Head"].points.stop).all(axis=1)
        drops = drop[self._skin] / drop[below]
        self._lower = self._skin[near & (drops > _DROPS).all(axis=1)]
        self._upper = self._skin[near & (drops < _STAYS).all(axis=1)]

    def teeth(self, points: FloatArray) -> int:
        """Cells of 0.5 mm in which the front view of points (n, 3) mm shows teeth."""
        grid = Grid.of(points, self._teeth)
        teeth, skin, gums = (grid.first(triangles)[0] for triangles in (self._teeth, self._skin, self._gums))
        return int(((teeth > skin) & (teeth > gums)).sum())

    def overlap(self, points: FloatArray) -> float:
        """Millimetres of the upper lip's lowest below the lower lip's highest, on one vertical; negative: apart."""
        grid = Grid.of(points @ _FROM_ABOVE.T, np.concatenate([self._lower, self._upper]))
        highest, lowest = grid.first(self._lower)[0], grid.last(self._upper)
        both = np.isfinite(highest) & np.isfinite(lowest)
        return float((highest - lowest)[both].max(initial=-np.inf))
