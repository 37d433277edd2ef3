"""The actor's starting shapes (document S14): what other people do, carried to the actor's neutral."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError, TopologyError
from facepipe.core.threads import one_thread
from facepipe.geometry.deformation_transfer import Transfer
from facepipe.processors.database import FaceDatabase, predicted_shapes, whole_face
from facepipe.processors.rebuild.options import PersonalTemplateOptions
from facepipe.processors.rebuild.template import Template


@dataclass(frozen=True, kw_only=True)
class PersonalTemplate:
    """An actor's starting shapes from the neutral: by the multilinear model, or by deformation transfer."""

    options: PersonalTemplateOptions = field(default_factory=PersonalTemplateOptions)

    @one_thread()
    def __call__(
        self,
        template: Template,
        neutral: FloatArray,
        database: FaceDatabase | None = None,
        done: Callable[[], object] = lambda: None,
    ) -> dict[str, FloatArray]:
        """Shape -> (n, 3) whole delta from `neutral` (n, 3), millimetres, in the order of the source.

        :param done: called once for each shape
        :raises InputError: neither has shapes
        :raises TopologyError: a database of another topology
        """
        if self._from(template, database) and database is not None:
            return predicted_shapes(database, neutral, done=done)
        return _transferred(template, neutral, done)

    def names(self, template: Template, database: FaceDatabase | None = None) -> tuple[str, ...]:
        """Those of the shapes that come of these, without making them.

        :raises InputError: neither has shapes
        :raises TopologyError: a database of another topology
        """
        if self._from(template, database) and database is not None:
            return database.shapes
        found = tuple(dict.fromkeys(shape.name for mesh in template.parts.meshes for shape in mesh.blendshapes))
        if not found:
            raise InputError(template.where, "has no blendshapes, expected some to start from")
        return found

    def _from(self, template: Template, database: FaceDatabase | None) -> bool:
        """Whether shapes come from the database."""
        source = self.options.shapes_from
        known = database is not None and database.expressions is not None
        if source == "database" or (source == "auto" and known):
            if database is None or not known:
                raise InputError("database", "has no expressions, expected some (or shapes from the template)")
            if database.topology.digest != template.topology.digest:
                raise TopologyError(template.where, "other meshes or faces than the database has, expected the same")
            return True
        return False


def _transferred(template: Template, neutral: FloatArray, done: Callable[[], object]) -> dict[str, FloatArray]:
    deltas = whole_face(template.parts, template.where).deltas
    if not deltas:
        raise InputError(template.where, "has no blendshapes, expected some to start from")
    transfer = Transfer(neutral, template.topology.triangles, np.zeros(len(neutral), bool))
    found: dict[str, FloatArray] = {}
    for name, delta in deltas.items():
        found[name] = transfer.solve(template.points[None], (template.points + delta)[None]) - neutral
        done()
    return found
