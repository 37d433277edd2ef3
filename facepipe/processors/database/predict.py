"""A person's expressions, from the neutral and those that have been seen, by what a database knows of people."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.geometry.deformation_transfer import Transfer
from facepipe.processors.database.face_database import FaceDatabase


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
    that has them elsewhere; a model of so few people as a database has can't tell that from the neutral.

    :param seen: expression -> (n, 3) points of it that are known
    :param done: called once for each expression
    :raises InputError: no expressions in the database, one of another name, or another number of points
    """
    model = database.expressions
    if model is None:
        raise InputError("database", "has no expressions, expected some")
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
    own = np.asarray(neutral, dtype=np.float64)
    if own.shape != database.identity.mean.shape:
        raise InputError("neutral", f"points {own.shape}, expected {database.identity.mean.shape}")
    nobody = np.zeros(model.vectors.shape[1])
    mean = model.neutral(nobody)
    transfer = Transfer(own, database.topology.triangles, np.zeros(len(own), dtype=bool))
    found = np.empty((len(model.names), *own.shape))
    for number, name in enumerate(model.names):
        found[number] = transfer.solve(mean[None], (mean + model.shape(nobody, name))[None]) - own
        done()
    return found
