"""Composites: which shapes, and how much of each, a scan shows: an expression's, and what a neutral's shows besides.

Names are ARKit's with sides as ICT-FaceKit writes them; `resolved` finds them as a face has them: ``mouthSmileLeft``,
``mouthSmile_L``, and ``browInnerUp`` for both of its sides. ``mouthClose`` corrects ``jawOpen``: it closes the lips of
an open jaw, and never goes without it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.names import suggestion
from facepipe.geometry.deformation_transfer import Transfer
from facepipe.geometry.registration import Shown
from facepipe.kinds import found_of
from facepipe.parts import Recipe
from facepipe.scanning.database import FaceDatabase
from facepipe.scanning.rebuild.template import Template
from facepipe.verbs.whole_faces import whole_face

_SIDES = ("_L", "_R")


def _both(**weights: float) -> dict[str, float]:
    return {f"{name}{side}": weight for name, weight in weights.items() for side in _SIDES}


DEFAULT_COMPOSITES: dict[str, dict[str, float]] = {
    "jaw_open": {"jawOpen": 0.8},
    "jaw_open_lips_closed": {"jawOpen": 0.6, "mouthClose": 0.6},
    "jaw_forward": {"jawForward": 0.8},
    "smile": _both(mouthSmile=1.0, cheekSquint=0.6),
    "laugh": {"jawOpen": 0.5, **_both(mouthSmile=0.8, cheekSquint=0.8, eyeSquint=0.6)},
    "brows_up": _both(browInnerUp=1.0, browOuterUp=0.9, eyeWide=0.8),
    "anger": _both(browDown=1.0, noseSneer=0.7, mouthPress=0.5),
    "closed_eyes": _both(eyeBlink=1.0),
    "squint": _both(eyeSquint=1.0, cheekSquint=0.9),
    "pucker": {"mouthPucker": 1.0},
    "funnel": {"mouthFunnel": 1.0, "jawOpen": 0.3},
    "sad": {"mouthShrugLower": 0.6, **_both(mouthFrown=1.0, browInnerUp=0.7)},
    "left": {"mouthLeft": 0.9, "jawLeft": 0.8, "eyeBlink_L": 0.7},
    "right": {"mouthRight": 0.9, "jawRight": 0.8, "eyeBlink_R": 0.7},
    "teeth": _both(mouthUpperUp=0.9, mouthLowerDown=0.9),
    "stretch": {"jawOpen": 0.4, **_both(mouthStretch=1.0, mouthDimple=0.5)},
    "rolled": {"mouthRollUpper": 0.9, "mouthRollLower": 0.9, "jawForward": 0.6, "mouthShrugUpper": 0.4},
    "cheeks_puffed": _both(cheekPuff=1.0),
    "look_up": _both(eyeLookUp=1.0),
    "look_down": _both(eyeLookDown=1.0),
}
"""Scanned expression -> shapes and their weights, where a project does not say."""


def resolved(composite: Mapping[str, float], shapes: Sequence[str], where: str) -> dict[str, float]:
    """The weights of a composite by the names that a face's `shapes` have, in their order.

    :raises InputError: no weight, one out of 0 to 2, or a shape that the face lacks
    """
    if not composite:
        raise InputError(where, "names no shape, expected a weight for each shape that it shows")
    known = set(shapes)
    weights: dict[str, float] = {}
    for name, weight in composite.items():
        if not 0.0 < weight <= 2.0:
            raise InputError(f"{where} -> {name}", f"weight {weight}, expected one above 0, up to 2")
        shape = next((each for each in _spellings(name) if each in known), None)
        if shape is None:
            raise InputError(f"{where} -> {name}", f"no such shape{suggestion(name, shapes)}")
        weights[shape] = max(weight, weights.get(shape, 0.0))
    return {name: weights[name] for name in shapes if name in weights}


def _spellings(name: str) -> tuple[str, ...]:
    """A name as it is, with the other way to write its side, and without."""
    for short, long in (("_L", "Left"), ("_R", "Right")):
        for end, other in ((short, long), (long, short)):
            if name.endswith(end) and name != end:
                stem = name.removesuffix(end)
                return (name, stem + other, stem)
    return (name,)


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
        :raises InputError: a shape that the template lacks, or a weight out of 0 to 2
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
