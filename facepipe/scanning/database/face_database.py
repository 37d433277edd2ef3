"""A database of faces of one topology: who is in it, the models of identity and expressions, and what these predict."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.geometry.deformation_transfer import Transfer
from facepipe.geometry.expression_model import ExpressionModel
from facepipe.geometry.identity_model import IdentityModel
from facepipe.scanning.database.options import Quality
from facepipe.verbs.whole_faces import Topology

REMOVE = "remove"  # the verb of updates whose entries went


@dataclass(frozen=True, kw_only=True)
class StoredError:
    """How far the points of a face's expressions are from what the database holds of them, in millimetres."""

    rms_mm: float
    p95_mm: float
    max_mm: float


@dataclass(frozen=True, kw_only=True)
class Entry:
    """A face in the database."""

    name: str
    source: str  # file name of the stage it came from
    digest: str  # of that file and its layers
    content: str  # digest of its points and shapes
    version: int  # of the database, the first that has it
    stored_error: StoredError | None  # None: it has no expressions, and is in the identity model alone
    quality: Quality | None = None  # measures that it came with


@dataclass(frozen=True, kw_only=True)
class Update:
    """One change of the database."""

    version: int
    verb: str  # "create", "add", "remove"
    entries: tuple[str, ...]  # that came, or went
    dropped: tuple[str, ...] = ()  # shapes that went, as not all faces have them
    ignored: tuple[str, ...] = ()  # why the quality gate would have refused
    facepipe: str  # version


@dataclass(frozen=True, kw_only=True)
class FaceDatabase:
    """Whole points are those of all meshes one after another, world space, millimetres, Y up."""

    topology: Topology
    identity: IdentityModel  # n whole points
    coefficients: FloatArray  # (m, k) of the entries' neutrals, in standard deviations
    expressions: ExpressionModel | None  # of the entries that have some, in order; None: no face has
    shape_meshes: Mapping[str, tuple[str, ...]] = field(default_factory=dict)  # expression -> meshes that it moves
    left_out: Mapping[str, tuple[str, ...]] = field(default_factory=dict)  # shape -> entries that lack it
    entries: tuple[Entry, ...]
    history: tuple[Update, ...]
    tolerance_mm: float  # RMS to which the points of each shape are held

    @property
    def version(self) -> int:
        """Grows by one with each update."""
        return self.history[-1].version

    @property
    def shapes(self) -> tuple[str, ...]:
        """Names of the expressions."""
        return self.expressions.names if self.expressions else ()

    def neutrals(self) -> FloatArray:
        """(m, n, 3) of the entries."""
        return self.identity.points(self.coefficients)

    def deltas(self, name: str) -> Mapping[str, FloatArray]:
        """Expression -> (n, 3) delta of an entry, as it is held; none for one without expressions."""
        people = [entry.name for entry in self.entries if entry.stored_error is not None]
        if self.expressions is None or name not in people:
            return {}
        found = self.expressions.shapes(self.expressions.vectors[people.index(name)])
        return dict(zip(self.expressions.names, found, strict=True))


def predicted_shapes(
    database: FaceDatabase,
    neutral: FloatArray,
    seen: Mapping[str, FloatArray] | None = None,
    *,
    done: Callable[[], object] = lambda: None,
) -> dict[str, FloatArray]:
    """Expression -> (n, 3) delta from `neutral` (n, 3), of all expressions of the database.

    The mean person's expressions are carried over to the neutral, and what the person has beyond them is what the
    person's identity vector says (document face-model-from-scans, S14). Means alone lie beside the features of a face
    that has them elsewhere; a model of the few people in a database can't see that in the neutral.

    :param seen: expression -> (n, 3) points of it that are known
    :param done: called once for each expression
    :raises InputError: no expressions in the database, one of another name, or another number of points
    """
    model = database.expressions
    if model is None:
        raise InputError("database", "has no expressions, expected some")
    # Carried first: what the vector then adds is small, and stands where this face has its features.
    start = carried_mean(database, neutral, done=done)
    vector = model.identity_from(seen or {}, neutral, start)
    return dict(zip(model.names, model.shapes(vector, start), strict=True))


def carried_mean(
    database: FaceDatabase, neutral: FloatArray, *, done: Callable[[], object] = lambda: None
) -> FloatArray:
    """(e, n, 3) the mean person's expressions on `neutral` (n, 3), by deformation transfer.

    :param done: called once for each expression
    :raises InputError: no expressions in the database, or another number of points
    """
    model = database.expressions
    if model is None:
        raise InputError("database", "has no expressions, expected some")
    points = np.asarray(neutral, dtype=np.float64)
    if points.shape != database.identity.mean.shape:
        raise InputError("neutral", f"points {points.shape}, expected {database.identity.mean.shape}")
    nobody = np.zeros(model.vectors.shape[1])
    mean = model.neutral(nobody)
    transfer = Transfer(points, database.topology.triangles, np.zeros(len(points), dtype=bool))
    deltas = np.empty((len(model.names), *points.shape))
    for number, name in enumerate(model.names):
        deltas[number] = transfer.solve(mean[None], (mean + model.shape(nobody, name))[None]) - points
        done()
    return deltas
