"""The actor's starting shapes (document S14): what other people do, carried to the actor's neutral."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError, TopologyError
from facepipe.core.names import first_names
from facepipe.core.reports import Report
from facepipe.core.threads import one_thread
from facepipe.geometry.deformation_transfer import Transfer
from facepipe.parts import Recipe
from facepipe.scanning.database import FaceDatabase, predicted_shapes
from facepipe.scanning.rebuild.declared import PersonalTemplateOptions
from facepipe.scanning.rebuild.template import Template
from facepipe.stage import Face
from facepipe.verbs.author_neutral import AuthorNeutral
from facepipe.verbs.whole_faces import whole_face

_MOVED = 0.05  # of a shape's largest motion: points that move less are not what it moves
_USUAL = PersonalTemplateOptions()


def shapes_source(
    template: Template, database: FaceDatabase | None, options: PersonalTemplateOptions
) -> FaceDatabase | None:
    """The database where starting shapes come from it, None where they come from the template.

    :raises InputError: a database without shapes that are to come from it
    :raises TopologyError: a database of another topology
    """
    wanted, known = options.shapes_from, database is not None and database.expressions is not None
    if wanted == "template" or (wanted == "auto" and not known):
        return None
    if database is None or not known:
        raise InputError("database", "has no expressions, expected some (or shapes from the template)")
    if database.topology.digest != template.topology.digest:
        raise TopologyError(template.where, "other meshes or faces than the database has, expected the same")
    return database


def starting_names(
    template: Template, database: FaceDatabase | None = None, options: PersonalTemplateOptions = _USUAL
) -> tuple[str, ...]:
    """Those of the shapes that come of these, without making them.

    :raises InputError: neither has shapes
    :raises TopologyError: a database of another topology
    """
    source = shapes_source(template, database, options)
    names = template.parts.shapes if source is None else source.shapes
    if not names:
        raise InputError(template.where, "has no blendshapes, expected some to start from")
    return names


@one_thread()
def starting_shapes(
    template: Template,
    neutral: FloatArray,
    database: FaceDatabase | None = None,
    options: PersonalTemplateOptions = _USUAL,
    done: Callable[[], object] = lambda: None,
) -> dict[str, FloatArray]:
    """Shape -> (n, 3) whole delta from `neutral` (n, 3), millimetres, in the order of the source.

    :param done: called once for each shape
    :raises InputError: neither has shapes
    :raises TopologyError: a database of another topology
    """
    source = shapes_source(template, database, options)
    if source is not None:  # by the multilinear model
        return predicted_shapes(source, neutral, done=done)
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


def author_personal(
    face: Face,
    template: Template,
    database: FaceDatabase | None,
    options: PersonalTemplateOptions,
    recipe: Recipe,
    done: Callable[[], object],
) -> PersonalReport:
    """Author starting shapes on `face`, which stands over a person's neutral, in place of the template's.

    :param done: called once for each shape
    :raises TopologyError: a face or database of another topology than the template
    :raises InputError: nothing to make shapes of
    """
    # The neutral as it stands, corrected by hand or not.
    own = whole_face(face.parts(), face.where)
    if own.topology.digest != template.topology.digest:
        raise TopologyError(face.where, f"other meshes or faces than {template.where}, expected the same")
    shapes = starting_shapes(template, own.points, database, options, done)
    report = AuthorNeutral(shapes=shapes)(face, own.points, recipe=recipe)
    warnings, left = list(report.warnings), [name for name in own.deltas if name not in shapes]
    if left:
        warnings.append(f"{len(left)} shapes that the source lacks stay as they are: {first_names(left, 6)}")
    generic = whole_face(template.parts, template.where).deltas
    return PersonalReport(
        source="from the template" if shapes_source(template, database, options) is None else "from the database",
        motion_mm={name: float(np.linalg.norm(one, axis=1).max(initial=0.0)) for name, one in shapes.items()},
        change_mean_mm=_change(shapes, generic),
        authored=report.authored,
        warnings=tuple(warnings),
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
