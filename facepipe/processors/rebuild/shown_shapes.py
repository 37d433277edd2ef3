"""What the scan of a neutral shows besides the neutral: closed eyes, a little of an expression."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.geometry.deformation_transfer import Transfer
from facepipe.geometry.registration import Shown
from facepipe.kinds import found_of
from facepipe.parts import Recipe
from facepipe.processors.database import FaceDatabase, whole_face
from facepipe.processors.rebuild.composites import resolved
from facepipe.processors.rebuild.template import Template


@dataclass(frozen=True, kw_only=True)
class ShownShapes:
    """Shapes on the mean person of a database, and about how much of each a scan shows."""

    deltas: Mapping[str, FloatArray] = field(default_factory=dict)  # name -> (n, 3) whole deltas, millimetres
    weights: Mapping[str, float] = field(default_factory=dict)  # of the same names

    @classmethod
    def carried_over(
        cls, template: Template, database: FaceDatabase, weights: Mapping[str, float], where: str
    ) -> ShownShapes:
        """The template's own shapes, carried over to the database's mean person: of a scan's own person, nothing is
        known yet, and the residual takes up how that person differs.

        :param weights: by names as `resolved` finds them
        :raises InputError: a shape that the template has not, or a weight out of 0 to 2
        """
        if not weights:
            return cls()
        template_deltas = whole_face(template.parts, template.where).deltas
        if not template_deltas:
            raise InputError(where, f"{template.where} has no blendshapes, expected those that the scan shows")
        named, mean = resolved(weights, tuple(template_deltas), where), database.identity.mean
        transfer = Transfer(mean, template.topology.triangles, np.zeros(len(mean), bool))
        rest = template.points
        deltas = {name: transfer.solve(rest[None], (rest + template_deltas[name])[None]) - mean for name in named}
        return cls(deltas=deltas, weights=named)

    def expression(self, weights: Mapping[str, float], count: int) -> FloatArray:
        """(n, 3) whole delta of `count` points by weights of its shapes."""
        return np.asarray(sum((weight * self.deltas[name] for name, weight in weights.items()), np.zeros((count, 3))))

    def prior(self, template: Template, sigma: float) -> Shown | None:
        """For a registration of the template's rows; None where nothing is shown.

        :param sigma: how far a weight may be from the given one
        """
        if not self.weights:
            return None
        count = len(self.weights)
        return Shown(
            modes=np.stack([self.deltas[name][template.rows] for name in self.weights]),
            expected=np.array(list(self.weights.values())),
            precision=np.full(count, 1.0 / sigma**2),
        )


def shown_before(recipe: Recipe | None) -> dict[str, float]:
    """Weights of the shapes that the scan of a neutral shows besides, as its recipe says that they were found."""
    weights = found_of(recipe).get("weights")
    if not isinstance(weights, Mapping) or not all(isinstance(one, int | float) for one in weights.values()):
        return {}
    return {str(name): float(weight) for name, weight in weights.items() if 0.0 < weight <= 2.0}
