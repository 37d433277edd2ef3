"""A template's shapes on the mesh of another head.

Deformation transfer (Sumner & Popović 2004) runs on the template's triangles, from its neutral to what the fit made of
it: those are good, and the head's may be slivers, n-gons or a scan's. From there each point of the head takes what its
place on the template moves by, and what no place is near enough for is filled in on the head's own mesh.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.threads import one_thread
from facepipe.geometry.deformation_transfer import Transfer
from facepipe.geometry.factor import factorise
from facepipe.geometry.gradient_system import cotangent_weights, incidence
from facepipe.geometry.polygons import point_areas
from facepipe.scanning.rebuild.template import Template
from facepipe.scanning.transfer.fit import HeadFit
from facepipe.scanning.transfer.places import REACH_MM, nearest_places, places_on
from facepipe.scanning.transfer.sides import sides_on

FADE_MM = 60.0  # over which motion dies out on the head's mesh, away from the template
_STILL_MM = 8.0  # over which it passes into what a shape leaves still


@dataclass(frozen=True, kw_only=True)
class Carried:
    """Shapes on a head, in the head's own coordinates."""

    deltas: Mapping[str, FloatArray]  # name -> (m, 3)
    reached: BoolArray  # (m,) points that the template lies near; others move as those around them
    sides: IntArray  # (m,) +1 and -1 of the upper and lower lip, +-2 of the right lids, +-3 of the left ones, 0 neither


def carried(
    template: Template,
    fit: HeadFit,
    shapes: Mapping[str, FloatArray],
    progress: Callable[[str], None] = lambda name: None,
) -> Carried:
    """Shapes of the template on the head that it was fitted to.

    :param shapes: name -> (n, 3) whole deltas of the template, millimetres
    :raises InputError: NaN or infinity
    """
    with one_thread():
        carrier = Carrier(template, fit)
        deltas = {}
        for name, delta in shapes.items():
            deltas[name] = carrier.carry(delta)
            progress(name)
    group = fit.head.group
    return Carried(deltas=deltas, reached=carrier.reached[group], sides=carrier.sides[group])


class Carrier:
    """What carrying shapes to one head has in common."""

    def __init__(self, template: Template, fit: HeadFit) -> None:
        self._template, self._fit, head = template, fit, fit.head
        rows = fit.points[template.rows]
        self._neutral = template.points[template.rows]
        self._rows = rows
        self._transfer = Transfer(rows, template.triangles, np.zeros(len(rows), bool))
        self._own = screened(rows, template.triangles, _STILL_MM)
        nearest = nearest_places(rows, template.triangles, head)
        labels, self.sides = sides_on(template, rows, head, nearest, REACH_MM)
        self.places = places_on(rows, template.triangles, head, labels, self.sides)
        self.reached = self.places.distances <= REACH_MM
        self._fill = Fill(screened(head.points, head.triangles, FADE_MM), self.reached)

    def carry(self, delta: FloatArray) -> FloatArray:
        """(m, 3) delta of the head, in its own coordinates, of a whole delta (n, 3) of the template."""
        own = delta[self._template.rows]
        on_rows = self._transfer.solve(self._neutral[None], (self._neutral + own)[None]) - self._rows
        # Gradients alone drift, by 4 mm over a neck longer than the template's. What the shape leaves still stays so,
        # and what is around passes into it: set to 0 it began with a step, and held in the solve it held the chin.
        still = np.asarray(~own.any(axis=1))
        on_rows += Fill(self._own, still).filled(np.where(still[:, None], -on_rows, 0.0))
        return self.laid(on_rows)

    def laid(self, on_rows: FloatArray) -> FloatArray:
        """(m, 3) delta of the head, in its own coordinates, where rows of the fitted template move by (r, 3)."""
        on_head = self._fill.filled(self.places.of(on_rows))
        place = self._fit.place
        return np.asarray((on_head @ place.rotation / place.scale)[self._fit.head.group])


def screened(points: FloatArray, triangles: IntArray, fade: float) -> Any:
    """(n, n) sparse ``L + M / fade^2``: a Laplacian whose solutions die out over `fade`, in the points' unit."""
    from scipy.sparse import diags_array

    pairs, weights = cotangent_weights(points, triangles)
    steps = incidence(pairs, len(points))
    areas = point_areas(points, triangles)
    least = 1e-6 * max(float(areas.mean()), np.finfo(np.float64).tiny)
    screen = diags_array(np.maximum(areas, least) / fade**2)
    return (steps.T @ diags_array(weights) @ steps + screen).tocsr()


class Fill:
    """Motion where it is not known: smooth on a mesh, and dying out.

    ``(L + M / fade^2) x = 0`` with the motion around as it is: a body below the neck, for which nothing else is known,
    would go along with it for ever.
    """

    def __init__(self, system: Any, known: BoolArray) -> None:
        self._known, self._open = known, np.flatnonzero(~known)
        rows = system[self._open]
        self._across = rows[:, np.flatnonzero(known)]
        self._factor = factorise(rows[:, self._open])

    def filled(self, values: FloatArray) -> FloatArray:
        """(s, 3) with those that are not known in place."""
        result = np.array(values)
        result[self._open] = self._factor.solve(-(self._across @ values[self._known]))
        return result
