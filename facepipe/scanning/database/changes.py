"""Databases made of faces, faces added to them, the same either way, and faces taken out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from facepipe.core import __version__
from facepipe.core.arrays import FloatArray, require_finite
from facepipe.core.errors import InputError, TopologyError
from facepipe.core.threads import one_thread
from facepipe.declare import check_ranges
from facepipe.geometry.expression_model import ExpressionModel
from facepipe.geometry.identity_model import IdentityModel
from facepipe.geometry.shape_basis import hold, narrowed, no_basis
from facepipe.geometry.similarity import fit_similarity
from facepipe.kinds import found_of
from facepipe.rig import set_face
from facepipe.scanning.database.face_database import REMOVE, Entry, FaceDatabase, StoredError, Update
from facepipe.scanning.database.options import AddOptions, DatabaseOptions, Quality, misses, quality_from
from facepipe.stage import open_face
from facepipe.stage.recipes import file_recipe, source_digest
from facepipe.verbs.whole_faces import Topology, WholeFace, whole_face

REBUILT = "rebuild"  # the verb of recipes that state measures
_SCALES = 2.0  # how much larger or smaller a face may be: more is another unit
_TURNED, _SHIFTED = 15.0, 50.0  # degrees and millimetres, beyond what faces of one place differ by
Source = Callable[[], WholeFace]  # reads a face: once to check it, once to add it


@dataclass
class StageSource:
    """One face stage, read anew by each call."""

    path: Path
    name: str
    base: StageSource | Topology | None = None  # whose meshes it must have, in which order
    base_name: str = ""
    _topology: Topology | None = None

    def __call__(self) -> WholeFace:
        """:raises FacepipeError: a file that can't be read, or another topology"""
        base = self.base.topology() if isinstance(self.base, StageSource) else self.base
        face = whole_face(set_face(open_face(self.path).parts()).parts, str(self.path), base, self.base_name)
        self._topology = face.topology
        return replace(face, name=self.name, source=self.path.name, digest=source_digest(self.path))

    def topology(self) -> Topology:
        """Its meshes."""
        return self._topology or self().topology

    def quality(self) -> Quality | None:
        """The measures on a rebuilt face; None on a face made otherwise.

        :raises InputError: a rebuilt face without them
        """
        recipe = file_recipe(self.path).recipe
        if recipe is None or recipe.verb != REBUILT:
            return None
        results = found_of(recipe)
        if "quality" not in results:
            what = "is rebuilt and states no quality, expected it in its recipe (or --quality, or --ignore-quality)"
            raise InputError(self.path, what)
        return quality_from(results["quality"], f"{self.path} -> recipe -> quality")


def stage_sources(
    paths: Sequence[Path], names: Sequence[str] = (), database: FaceDatabase | None = None, where: str = "the database"
) -> list[StageSource]:
    """Face stages as sources, on the topology of `database`, or of the first of them.

    :param names: one for each; those of the files by default
    :raises InputError: names that are not one for each, or twice
    """
    face_names = list(names) or [path.stem for path in paths]
    if len(face_names) != len(paths):
        raise InputError("names", f"{len(face_names)} names, expected {len(paths)}, one a face")
    for number, name in enumerate(face_names):
        if not name.strip() or name in face_names[:number]:
            raise InputError(paths[number], f"name '{name}' empty or twice, expected another by --names")
    sources: list[StageSource] = []
    for path, name in zip(paths, face_names, strict=True):
        base: StageSource | Topology | None = database.topology if database else sources[0] if sources else None
        base_name = where if database else str(paths[0])
        sources.append(StageSource(path=path, name=name, base=base, base_name=base_name))
    return sources


@dataclass(frozen=True, kw_only=True)
class Facts:
    """What is kept of a face between its two readings."""

    name: str
    topology: Topology
    points: FloatArray  # (n, 3)
    shapes: Mapping[str, tuple[str, ...]]  # shape -> meshes that it moves
    source: str
    digest: str
    content: str
    warnings: tuple[str, ...]


class Shapes(NamedTuple):
    """Those that all faces have that have any, and what became of the others."""

    names: tuple[str, ...]
    meshes: Mapping[str, tuple[str, ...]]  # of each, those that it moves in some face
    left_out: Mapping[str, tuple[str, ...]]  # shape -> the entries that have expressions and lack it
    dropped: tuple[str, ...]  # those of the database before that are no more
    warnings: tuple[str, ...]


def shapes_in_common(database: FaceDatabase | None, facts: Sequence[Facts]) -> Shapes:
    """The shapes of the entries of a database and of faces that come to it."""
    coming = [fact for fact in facts if fact.shapes]
    former = [entry.name for entry in database.entries if entry.stored_error is not None] if database else []
    before = database.shapes if database and former else (tuple(coming[0].shapes) if coming else ())
    names = tuple(shape for shape in before if all(shape in one.shapes for one in coming))
    seen = dict.fromkeys(
        (*before, *(database.left_out if database else ()), *(s for one in coming for s in one.shapes))
    )
    left_out, meshes = {}, {}
    for shape in seen:
        lacking = tuple(one.name for one in coming if shape not in one.shapes)
        old = database.shape_meshes.get(shape, ()) if database else ()
        if shape in names:
            meshes[shape] = tuple(dict.fromkeys((*old, *(mesh for one in coming for mesh in one.shapes[shape]))))
        elif database is None or shape in database.shapes:
            left_out[shape] = lacking
        else:
            left_out[shape] = (*database.left_out.get(shape, former), *lacking)
    warnings = [f"{one.name}: has no shapes, and enters the identity model alone" for one in facts if not one.shapes]
    if left_out:
        some = []
        for shape, people in sorted(left_out.items()):
            more = f" and {len(people) - 3} more" if len(people) > 3 else ""
            some.append(f"{shape} ({', '.join(people[:3])}{more})")
        warnings.append(f"shapes left out, as faces lack them: {', '.join(some)}")
    return Shapes(
        names=names,
        meshes=meshes,
        left_out=left_out,
        dropped=tuple(shape for shape in before if shape not in names) if former else (),
        warnings=tuple(warnings),
    )


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
    names = [fact.name for fact in facts]
    for name in qualities:
        if name not in names:
            raise InputError(f"quality -> {name}", f"no such face is added, expected one of {', '.join(names)}")
    missed = {name: misses(quality, options) for name, quality in qualities.items()}
    for name, lines in missed.items():
        if lines and not options.ignore_quality:
            raise InputError(name, f"refused: {'; '.join(lines)} (or --ignore-quality)")
    ignored = tuple(f"{name}: {line}" for name, lines in missed.items() for line in lines)
    shapes = shapes_in_common(database, facts)
    if shapes.dropped and not options.drop_shapes:
        name, lost = next(
            (fact.name, lost)
            for fact in facts
            if (lost := [shape for shape in database.shapes if fact.shapes and shape not in fact.shapes])
        )
        raise InputError(name, f"lacks {', '.join(lost)}, expected the shapes of the database (or --drop-shapes)")
    identity = database.identity.with_faces(np.stack([fact.points for fact in facts]))
    return _grown(database, sources, facts, identity, shapes, qualities, ignored, database.tolerance_mm, done)


def _read(sources: Sequence[Source], database: FaceDatabase | None, done: Callable[[], object]) -> list[Facts]:
    """What is kept of faces, which are of one topology, size and place, and each is new.

    :raises InputError: a name or a face twice, or a face of another size or place
    :raises TopologyError: another topology
    """
    facts = []
    for source in sources:
        face = source()
        # One NaN would be in every number of both models.
        require_finite(face.points, face.name)
        require_finite(face.deltas, face.name)
        facts.append(
            Facts(
                name=face.name,
                topology=face.topology,
                points=face.points,
                shapes={name: face.meshes.get(name, ()) for name in face.deltas},
                source=face.source,
                digest=face.digest,
                content=face.content,
                warnings=face.warnings,
            )
        )
        done()
    topology = database.topology if database else facts[0].topology
    mean = np.asarray(database.identity.mean if database else facts[0].points, np.float64)
    entries = database.entries if database else ()
    names = {entry.name: "the database" for entry in entries}
    known = {entry.content: entry.name for entry in entries} | {
        entry.digest: entry.name for entry in entries if entry.digest
    }
    for fact in facts:
        if fact.topology.digest != topology.digest:
            raise TopologyError(fact.name, f"{fact.topology.digest[:14]} of meshes, expected {topology.digest[:14]}")
        twin = known.get(fact.content) or known.get(fact.digest or fact.content)
        if twin is not None:
            raise InputError(fact.name, f"is the same face as {twin}, expected each face once")
        if fact.name in names:
            raise InputError(fact.name, f"a face of that name is in {names[fact.name]} too, expected another name")
        # One that stands elsewhere: what is place would enter the model as identity.
        fitted = fit_similarity(mean, fact.points)
        angle = float(np.degrees(np.arccos(np.clip((np.trace(fitted.rotation) - 1) / 2, -1, 1))))
        shift = float(np.linalg.norm(fact.points.mean(axis=0) - mean.mean(axis=0)))
        if not 1 / _SCALES < fitted.scale < _SCALES:
            what = f"{fitted.scale:.3g} times as large as the others, expected metersPerUnit to say so"
            raise InputError(fact.name, what)
        if angle > _TURNED or shift > _SHIFTED:
            what = f"stands {shift:.0f} mm and {angle:.0f} degrees away from the others"
            raise InputError(fact.name, f"{what}, expected faces in one place")
        names[fact.name] = "the line"
        known |= {fact.content: fact.name} | ({fact.digest: fact.name} if fact.digest else {})
    return facts


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
    entries = (database.entries if database else ()) + tuple(
        Entry(
            name=one.name,
            source=one.source,
            digest=one.digest,
            content=one.content,
            version=version,
            stored_error=error,
            quality=qualities.get(one.name),
        )
        for one, error in zip(facts, errors, strict=True)
    )
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
    of_people = (shapes.names, identity, coefficients[people], basis, deltas)
    model = ExpressionModel.from_people(*of_people) if shapes.names else None
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
    warnings = [*(line for fact in facts for line in fact.warnings), *shapes.warnings]
    for face in facts:
        still = [
            f"{shape} ({', '.join(lost)})"
            for shape, known in shapes.meshes.items()
            if shape in face.shapes and (lost := [mesh for mesh in known if mesh not in face.shapes[shape]])
        ]
        if still:
            warnings.append(f"{face.name}: meshes that stay still, unlike in other faces: {', '.join(still)}")
    return Made(made, (*warnings, *ignored))


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
            deltas = np.array([face.deltas[name] for name in names]).reshape(-1, *face_facts.points.shape)
            held = hold(basis, deltas, tolerance)
            basis = held.basis
            rows.append(held.coefficients)
            off = held.distances if held.distances.size else np.zeros(1)
            errors.append(
                StoredError(
                    rms_mm=float(np.sqrt(np.square(off).mean())),
                    p95_mm=float(np.percentile(off, 95)),
                    max_mm=float(off.max()),
                )
            )
        else:
            errors.append(None)
        done()
    # The basis grows at its end: those who came before have nothing of what was appended later.
    padded = [np.pad(row, ((0, 0), (0, len(basis) - row.shape[1]))) for row in rows]
    return basis, np.array(padded).reshape(len(rows), len(names), len(basis)), errors


@one_thread()
def remove_faces(database: FaceDatabase, names: Sequence[str], where: str = "the database") -> Made:
    """`database` without some of its faces: what `create_database` makes of the others, within its tolerance.

    A shape that only those lacked who go stays left out, with a warning: what the others have of it is not kept.

    :param names: of entries
    :param where: the database's place in error messages
    :raises InputError: a name that is not there, or is given twice, or fewer than two faces would stay
    """
    known = [entry.name for entry in database.entries]
    for number, name in enumerate(names):
        if name not in known:
            raise InputError(f"{where} -> {name[:60]}", "no face of that name (facepipe database info lists them)")
        if name in names[:number]:
            raise InputError(f"{where} -> {name[:60]}", "is given twice, expected each name once")
    left = len(known) - len(names)
    if left < 2:
        raise InputError(where, f"{left} of {len(known)} faces would stay, expected 2 or more")
    stays = np.array([name not in names for name in known])
    entries = tuple(entry for entry, own in zip(database.entries, stays, strict=True) if own)
    neutrals = database.neutrals()[stays]
    identity = IdentityModel.from_faces(neutrals)
    coefficients = identity.coefficients(neutrals)
    people = [number for number, entry in enumerate(entries) if entry.stored_error is not None]
    left_out = {
        shape: tuple(name for name in lacking if name not in names) for shape, lacking in database.left_out.items()
    }
    update = Update(version=database.version + 1, verb=REMOVE, entries=tuple(names), facepipe=__version__)
    model, known_model = None, database.expressions
    if people and known_model is not None:  # in what of the basis they need
        former = np.array([entry.stored_error is not None for entry in database.entries])
        basis, deltas = narrowed(known_model.basis, known_model.deltas[stays[former]])
        model = ExpressionModel.from_people(known_model.names, identity, coefficients[people], basis, deltas)
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
    free = sorted(shape for shape, lacking in made.left_out.items() if not lacking)
    lines: tuple[str, ...] = ()
    if known_model is not None and model is None:
        lines = ("the faces that stay have no shapes: the model of expressions goes",)
    elif free:
        lines = (f"no face lacks {', '.join(free)} any more: left out until the database is created anew",)
    return Made(made, lines)
