"""A template's shapes on the mesh of another head.

Deformation transfer (Sumner & Popović 2004) runs on the template's triangles, from its neutral to what the fit made of
it: those are good, and the head's may be slivers, n-gons or a scan's. From there each point of the head takes what its
place on the template moves by, and what no place is near enough for is filled in on the head's own mesh.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.threads import one_thread
from facepipe.geometry.deformation_transfer import Transfer
from facepipe.geometry.factor import factorise
from facepipe.geometry.gradient_system import cotangent_weights, incidence
from facepipe.geometry.polygons import point_areas
from facepipe.scanning.rebuild.template import Template
from facepipe.scanning.transfer.fit import HeadFit
from facepipe.scanning.transfer.mesh import HeadMesh
from facepipe.scanning.transfer.places import REACH_MM, nearest_places, places_on
from facepipe.scanning.transfer.sides import sides_on

_FADE_MM = 60.0  # over which motion dies out on the head's mesh, away from the template


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
        nearest = nearest_places(rows, template.triangles, head)
        labels, self.sides = sides_on(template, rows, head, nearest, REACH_MM)
        self.places = places_on(rows, template.triangles, head, labels, self.sides)
        self.reached = self.places.distances <= REACH_MM
        self._fill = Fill(head, self.reached)

    def carry(self, delta: FloatArray) -> FloatArray:
        """(m, 3) delta of the head, in its own coordinates, of a whole delta (n, 3) of the template."""
        own = delta[self._template.rows]
        # what the shape leaves still is held: gradients alone drift, by 3 mm over a neck longer than the template's
        still = np.asarray(~own.any(axis=1))
        transfer = Transfer(self._rows, self._template.triangles, still)
        on_rows = transfer.solve(self._neutral[None], (self._neutral + own)[None]) - self._rows
        on_head = self._fill.filled(self.places.of(on_rows))
        place = self._fit.place
        return np.asarray((on_head @ place.rotation / place.scale)[self._fit.head.group])


class Fill:
    """Motion where the template does not reach: smooth on the head's own mesh, and dying out.

    ``(L + M / fade^2) x = 0`` with the motion around as it is: a screened Laplacian, since a body below the neck, for
    which nothing else is known, would go along with it for ever.
    """

    def __init__(self, head: HeadMesh, known: BoolArray) -> None:
        from scipy.sparse import diags_array

        self._known, self._open = known, np.flatnonzero(~known)
        pairs, weights = cotangent_weights(head.points, head.triangles)
        steps = incidence(pairs, len(head.points))
        areas = point_areas(head.points, head.triangles)
        least = 1e-6 * max(float(areas.mean()), np.finfo(np.float64).tiny)
        screen = diags_array(np.maximum(areas, least) / _FADE_MM**2)
        system = (steps.T @ diags_array(weights) @ steps + screen).tocsr()[self._open]
        self._across = system[:, np.flatnonzero(known)]
        self._factor = factorise(system[:, self._open])

    def filled(self, values: FloatArray) -> FloatArray:
        """(s, 3) with those that are not known in place."""
        result = np.array(values)
        result[self._open] = self._factor.solve(-(self._across @ values[self._known]))
        return result
