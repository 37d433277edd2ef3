"""The actor's starting shapes (document S14): what other people do, carried to the actor's neutral."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError, TopologyError
from facepipe.core.names import first_names
from facepipe.core.reports import Report
from facepipe.core.threads import one_thread
from facepipe.geometry.deformation_transfer import Transfer
from facepipe.parts import Recipe
from facepipe.scanning.database import FaceDatabase, predicted_shapes
from facepipe.scanning.rebuild.options import PersonalTemplateOptions
from facepipe.scanning.rebuild.template import Template
from facepipe.stage import Face
from facepipe.verbs.author_neutral import AuthorNeutral
from facepipe.verbs.whole_faces import WholeFace, whole_face

_MOVED = 0.05  # of a shape's largest motion: points that move less are not what it moves


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
        source = self.source(template, database)
        return _transferred(template, neutral, done) if source is None else predicted_shapes(source, neutral, done=done)

    def names(self, template: Template, database: FaceDatabase | None = None) -> tuple[str, ...]:
        """Those of the shapes that come of these, without making them.

        :raises InputError: neither has shapes
        :raises TopologyError: a database of another topology
        """
        source = self.source(template, database)
        names = template.parts.shapes if source is None else source.shapes
        if not names:
            raise InputError(template.where, "has no blendshapes, expected some to start from")
        return names

    def source(self, template: Template, database: FaceDatabase | None) -> FaceDatabase | None:
        """The database where shapes come from it, None where they come from the template.

        :raises InputError: a database without shapes that are to come from it
        :raises TopologyError: a database of another topology
        """
        wanted, known = self.options.shapes_from, database is not None and database.expressions is not None
        if wanted == "template" or (wanted == "auto" and not known):
            return None
        if database is None or not known:
            raise InputError("database", "has no expressions, expected some (or shapes from the template)")
        if database.topology.digest != template.topology.digest:
            raise TopologyError(template.where, "other meshes or faces than the database has, expected the same")
        return database


def _transferred(template: Template, neutral: FloatArray, done: Callable[[], object]) -> dict[str, FloatArray]:
    deltas = whole_face(template.parts, template.where).deltas
    if not deltas:
        raise InputError(template.where, "has no blendshapes, expected some to start from")
    transfer = Transfer(neutral, template.topology.triangles, np.zeros(len(neutral), bool))
    shapes: dict[str, FloatArray] = {}
    for name, delta in deltas.items():
        shapes[name] = transfer.solve(template.points[None], (template.points + delta)[None]) - neutral
        done()
    return shapes


@dataclass(frozen=True, kw_only=True)
class PersonalReport(Report):
    """Where a person's starting shapes come from, and how they move."""

    source: str  # "from the database" or "from the template"
    motion_mm: Mapping[str, float]  # shape -> largest motion
    change_mean_mm: float  # from the template's own, over the points that these move, all shapes
    authored: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class AuthorPersonal:
    """Puts starting shapes on a person's face, in place of the template's."""

    template: Template
    make: PersonalTemplate = field(default_factory=PersonalTemplate)
    database: FaceDatabase | None = None

    @property
    def count(self) -> int:
        """How many shapes there are to make."""
        return len(self.make.names(self.template, self.database))

    def __call__(
        self, face: Face, *, recipe: Recipe | None = None, done: Callable[[], object] = lambda: None
    ) -> PersonalReport:
        """Author the shapes on `face`, which stands over the neutral.

        :param done: called once for each shape
        :raises TopologyError: a face or database of another topology than the template
        :raises InputError: nothing to make shapes of
        """
        whole = whole_face(face.parts(), face.where)
        if whole.topology.digest != self.template.topology.digest:
            raise TopologyError(face.where, f"other meshes or faces than {self.template.where}, expected the same")
        shapes = self.make(self.template, whole.points, self.database, done)
        report = AuthorNeutral(shapes=shapes)(face, whole.points, recipe=recipe)
        source = self.make.source(self.template, self.database)
        motion = {name: np.linalg.norm(delta, axis=1).max(initial=0.0) for name, delta in shapes.items()}
        generic = whole_face(self.template.parts, self.template.where).deltas
        return PersonalReport(
            source="from the template" if source is None else "from the database",
            motion_mm={name: float(largest) for name, largest in motion.items()},
            change_mean_mm=_change(shapes, generic),
            authored=report.authored,
            warnings=(*report.warnings, *_kept(whole, shapes)),
        )


def _change(shapes: Mapping[str, FloatArray], generic: Mapping[str, FloatArray]) -> float:
    """Mean distance of shapes from those of their names, over the points that these move; 0 where there are none."""
    off = [np.zeros(0)]
    for name, delta in shapes.items():
        if name in generic:
            motion = np.linalg.norm(generic[name], axis=1)
            moved = motion > _MOVED * motion.max(initial=0.0)
            off.append(np.linalg.norm(delta - generic[name], axis=1)[moved])
    every = np.concatenate(off)
    return float(every.mean()) if len(every) else 0.0


def _kept(own: WholeFace, shapes: Mapping[str, FloatArray]) -> Iterator[str]:
    left = [name for name in own.deltas if name not in shapes]
    if left:
        some = first_names(left, 6)
        yield f"{len(left)} shapes that the source lacks stay as they are: {some}"
