"""Faces taken out of databases."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from facepipe.core import __version__
from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.threads import one_thread
from facepipe.geometry.expression_model import ExpressionModel
from facepipe.geometry.identity_model import IdentityModel
from facepipe.geometry.shape_basis import narrowed
from facepipe.processors.database.create import Made
from facepipe.processors.database.face_database import REMOVE, Entry, FaceDatabase, Update


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
    model = _model(database, stays, identity, coefficients[people]) if people else None
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
    return Made(made, _warnings(database, entries, made))


def _staying(database: FaceDatabase, names: Sequence[str], where: str) -> npt.NDArray[np.bool_]:
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


def _model(
    database: FaceDatabase, stays: npt.NDArray[np.bool_], identity: IdentityModel, neutrals: FloatArray
) -> ExpressionModel | None:
    """The expressions of those who stay, in what of the basis they need."""
    if database.expressions is None:
        return None
    former = np.array([entry.stored_error is not None for entry in database.entries])
    basis, deltas = narrowed(database.expressions.basis, database.expressions.deltas[stays[former]])
    return ExpressionModel.from_people(database.expressions.names, identity, neutrals, basis, deltas)


def _warnings(database: FaceDatabase, entries: Sequence[Entry], made: FaceDatabase) -> tuple[str, ...]:
    if database.expressions is not None and made.expressions is None:
        return ("the faces that stay have no shapes: the model of expressions goes",)
    free = [shape for shape, lacking in made.left_out.items() if not lacking]
    if not free or len(entries) < 2:
        return ()
    return (f"nobody lacks {', '.join(sorted(free))} any more, which stay left out: create the database anew for them",)
