"""Databases made of faces, faces added to them, the same either way, and faces taken out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from facepipe.core import __version__
from facepipe.core.arrays import BoolArray, FloatArray
from facepipe.core.errors import InputError
from facepipe.core.threads import one_thread
from facepipe.declare import check_ranges
from facepipe.geometry.expression_model import ExpressionModel
from facepipe.geometry.identity_model import IdentityModel
from facepipe.geometry.shape_basis import hold, narrowed, no_basis
from facepipe.scanning.database.face_database import REMOVE, Entry, FaceDatabase, StoredError, Update
from facepipe.scanning.database.incoming_faces import (
    Facts,
    Shapes,
    check_faces,
    facts_of,
    mesh_warnings,
    shapes_in_common,
)
from facepipe.scanning.database.options import AddOptions, DatabaseOptions, Quality, misses
from facepipe.verbs.whole_faces import WholeFace

Source = Callable[[], WholeFace]  # reads a face: once to check it, once to add it


class Made(NamedTuple):
    """A database, and what is worth saying about the faces that came."""

    database: FaceDatabase
    warnings: tuple[str, ...]


@one_thread()
def create_database(
    sources: Sequence[Source], options: DatabaseOptions | None = None, *, done: Callable[[], object] = lambda: None
) -> Made:
    """The database of two or more faces of one topology.

    Expressions are the shapes that all faces have that have any; a face without shapes enters the identity model alone.

    :param done: called twice for each source
    :raises InputError: fewer than two faces, one twice, or faces that are all the same
    :raises TopologyError: faces that differ in topology, with the first difference
    """
    options = options or DatabaseOptions()
    check_ranges(options)
    if len(sources) < 2:
        raise InputError("sources", f"{len(sources)} face, expected 2 or more")
    facts = _read(sources, None, done)
    shapes = shapes_in_common(None, facts)
    identity = IdentityModel.from_faces(np.stack([fact.points for fact in facts]))
    return _grown(None, sources, facts, identity, shapes, {}, (), options.tolerance_mm, done)


@one_thread()
def add_faces(
    database: FaceDatabase,
    sources: Sequence[Source],
    options: AddOptions | None = None,
    *,
    qualities: Mapping[str, Quality] | None = None,
    done: Callable[[], object] = lambda: None,
) -> Made:
    """`database` and more faces: what `create_database` makes of all of them, of nothing but what `database` holds.

    :param qualities: measures by face name; a face without is not judged
    :param done: called twice for each source
    :raises InputError: no face, one that is there already, lacks a shape, or is refused by the quality gate
    :raises TopologyError: a face of another topology, with the first difference
    """
    options, qualities = options or AddOptions(), qualities or {}
    check_ranges(options)
    if not sources:
        raise InputError("sources", "no face, expected 1 or more")
    facts = _read(sources, database, done)
    ignored = _gate([fact.name for fact in facts], qualities, options)
    shapes = shapes_in_common(database, facts)
    if shapes.dropped and not options.drop_shapes:
        name, lost = next((fact.name, lost) for fact in facts if (lost := _lost(fact, database)))
        raise InputError(name, f"lacks {', '.join(lost)}, expected the shapes of the database (or --drop-shapes)")
    identity = database.identity.with_faces(np.stack([fact.points for fact in facts]))
    return _grown(database, sources, facts, identity, shapes, qualities, ignored, database.tolerance_mm, done)


def _read(sources: Sequence[Source], database: FaceDatabase | None, done: Callable[[], object]) -> list[Facts]:
    facts = []
    for source in sources:
        facts.append(facts_of(source()))
        done()
    check_faces(database, facts)
    return facts


def _gate(names: Sequence[str], qualities: Mapping[str, Quality], options: AddOptions) -> tuple[str, ...]:
    """What was missed and ignored.

    :raises InputError: a face misses a limit, or measures of nobody
    """
    for name in qualities:
        if name not in names:
            raise InputError(f"quality -> {name}", f"no such face is added, expected one of {', '.join(names)}")
    missed = {name: misses(quality, options) for name, quality in qualities.items()}
    for name, lines in missed.items():
        if lines and not options.ignore_quality:
            raise InputError(name, f"refused: {'; '.join(lines)} (or --ignore-quality)")
    return tuple(f"{name}: {line}" for name, lines in missed.items() for line in lines)


def _lost(one: Facts, database: FaceDatabase) -> list[str]:
    return [shape for shape in database.shapes if one.shapes and shape not in one.shapes]


def _grown(
    database: FaceDatabase | None,
    sources: Sequence[Source],
    facts: Sequence[Facts],
    identity: IdentityModel,
    shapes: Shapes,
    qualities: Mapping[str, Quality],
    ignored: tuple[str, ...],
    tolerance: float,
    done: Callable[[], object],
) -> Made:
    basis, deltas, errors = _held(database, sources, facts, shapes.names, tolerance, done)
    version = database.version + 1 if database else 1
    entries = database.entries if database else ()
    entries += tuple(_entry(one, version, error, qualities) for one, error in zip(facts, errors, strict=True))
    neutrals = np.concatenate([*([database.neutrals()] if database else []), [fact.points for fact in facts]])
    # All faces' anew: the model's axes turn with each face that comes.
    coefficients = identity.coefficients(neutrals)
    people = [number for number, entry in enumerate(entries) if entry.stored_error is not None]
    update = Update(
        version=version,
        verb="add" if database else "create",
        entries=tuple(fact.name for fact in facts),
        dropped=shapes.dropped,
        ignored=ignored,
        facepipe=__version__,
    )
    model = None
    if shapes.names:
        model = ExpressionModel.from_people(shapes.names, identity, coefficients[people], basis, deltas)
    made = FaceDatabase(
        topology=facts[0].topology,
        identity=identity,
        coefficients=coefficients,
        expressions=model,
        shape_meshes=shapes.meshes,
        left_out=shapes.left_out,
        entries=entries,
        history=(*(database.history if database else ()), update),
        tolerance_mm=tolerance,
    )
    warnings = [line for fact in facts for line in fact.warnings]
    return Made(made, (*warnings, *shapes.warnings, *mesh_warnings(facts, shapes.meshes), *ignored))


def _held(
    database: FaceDatabase | None,
    sources: Sequence[Source],
    facts: Sequence[Facts],
    names: Sequence[str],
    tolerance: float,
    done: Callable[[], object],
) -> tuple[FloatArray, FloatArray, list[StoredError | None]]:
    """The basis of deltas, what it gives for all people's (m, e, q), and how far that is off for those who came."""
    model = database.expressions if database else None
    basis = model.basis if model else no_basis(facts[0].topology.point_count)
    rows = [] if model is None else list(model.deltas[:, [model.names.index(name) for name in names]])
    errors: list[StoredError | None] = []
    for source, face_facts in zip(sources, facts, strict=True):
        if face_facts.shapes:
            face = source()
            held = hold(
                basis, np.array([face.deltas[name] for name in names]).reshape(-1, *face_facts.points.shape), tolerance
            )
            basis = held.basis
            rows.append(held.coefficients)
            errors.append(_error(held.distances))
        else:
            errors.append(None)
        done()
    # The basis grows at its end: those who came before have nothing of what was appended later.
    padded = [np.pad(row, ((0, 0), (0, len(basis) - row.shape[1]))) for row in rows]
    return basis, np.array(padded).reshape(len(rows), len(names), len(basis)), errors


def _error(distances: FloatArray) -> StoredError:
    if not distances.size:
        return StoredError(rms_mm=0.0, p95_mm=0.0, max_mm=0.0)
    return StoredError(
        rms_mm=float(np.sqrt(np.square(distances).mean())),
        p95_mm=float(np.percentile(distances, 95)),
        max_mm=float(distances.max(initial=0.0)),
    )


def _entry(facts: Facts, version: int, error: StoredError | None, qualities: Mapping[str, Quality]) -> Entry:
    return Entry(
        name=facts.name,
        source=facts.source,
        digest=facts.digest,
        content=facts.content,
        version=version,
        stored_error=error,
        quality=qualities.get(facts.name),
    )


@one_thread()
def remove_faces(database: FaceDatabase, names: Sequence[str], where: str = "the database") -> Made:
    """`database` without some of its faces: what `create_database` makes of the others, within its tolerance.

    A shape that only those lacked who go stays left out, with a warning: what the others have of it is not kept.

    :param names: of entries
    :param where: the database's place in error messages
    :raises InputError: a name that is not there, or is given twice, or fewer than two faces would stay
    """
    stays = _staying(database, names, where)
    entries = tuple(entry for entry, own in zip(database.entries, stays, strict=True) if own)
    neutrals = database.neutrals()[stays]
    identity = IdentityModel.from_faces(neutrals)
    coefficients = identity.coefficients(neutrals)
    people = [number for number, entry in enumerate(entries) if entry.stored_error is not None]
    left_out = {
        shape: tuple(name for name in lacking if name not in names) for shape, lacking in database.left_out.items()
    }
    update = Update(version=database.version + 1, verb=REMOVE, entries=tuple(names), facepipe=__version__)
    model = _model_of_those(database, stays, identity, coefficients[people]) if people else None
    made = FaceDatabase(
        topology=database.topology,
        identity=identity,
        coefficients=coefficients,
        expressions=model,
        shape_meshes=database.shape_meshes if model else {},
        left_out=left_out if people else {},
        entries=entries,
        history=(*database.history, update),
        tolerance_mm=database.tolerance_mm,
    )
    return Made(made, _removal_warnings(database, entries, made))


def _staying(database: FaceDatabase, names: Sequence[str], where: str) -> BoolArray:
    """(m,) entries that stay."""
    known = [entry.name for entry in database.entries]
    for number, name in enumerate(names):
        if name not in known:
            raise InputError(f"{where} -> {name[:60]}", "no face of that name (facepipe database info lists them)")
        if name in names[:number]:
            raise InputError(f"{where} -> {name[:60]}", "is given twice, expected each name once")
    left = len(known) - len(names)
    if left < 2:
        raise InputError(where, f"{left} of {len(known)} faces would stay, expected 2 or more")
    return np.array([name not in names for name in known])


def _model_of_those(
    database: FaceDatabase, stays: BoolArray, identity: IdentityModel, neutrals: FloatArray
) -> ExpressionModel | None:
    """The expressions of those who stay, in what of the basis they need."""
    if database.expressions is None:
        return None
    former = np.array([entry.stored_error is not None for entry in database.entries])
    basis, deltas = narrowed(database.expressions.basis, database.expressions.deltas[stays[former]])
    return ExpressionModel.from_people(database.expressions.names, identity, neutrals, basis, deltas)


def _removal_warnings(database: FaceDatabase, entries: Sequence[Entry], made: FaceDatabase) -> tuple[str, ...]:
    if database.expressions is not None and made.expressions is None:
        return ("the faces that stay have no shapes: the model of expressions goes",)
    free = [shape for shape, lacking in made.left_out.items() if not lacking]
    if not free or len(entries) < 2:
        return ()
    return (f"no face lacks {', '.join(sorted(free))} any more: left out until the database is created anew",)
