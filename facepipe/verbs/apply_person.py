"""A person of a payload as the neutral of a face."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.parts import FaceParts, Recipe
from facepipe.payload.person import PersonContent, encode_person
from facepipe.stage import Face
from facepipe.stage.author_changes import author_changes
from facepipe.verbs.author_neutral import AuthorNeutral
from facepipe.verbs.person_basis import Basis, database_basis, head_basis, is_head, template_basis
from facepipe.verbs.person_neutral import head_person_basis, settled, whole_with_others
from facepipe.verbs.person_rig import RigChange


def basis_for(content: PersonContent, parts: FaceParts, where: object, name: str, database: Path | None) -> Basis:
    """The basis that a person is on, of those that a face may have.

    :param where: of the payload
    :param name: of the face
    :raises InputError: none of them; or a database that can't be read
    """
    bases: list[Basis] = [database_basis(database, parts, name)] if database is not None else []
    if database is None:
        bases = [head_basis()] if is_head(parts, name) else []
        bases += [template_basis(parts, name)] if not bases or content.basis != bases[0].digest else []
    for basis in bases:
        if basis.digest == content.basis:
            return basis
    bases[0].check(content, where)
    return bases[0]


def apply_person(
    face: Face, points: FloatArray, basis: Basis, rig: RigChange | None = None, *, recipe: Recipe | None = None
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Put a person's points into the neutral of a face: what was authored, and warnings.

    Joints, lids, and cards of the built-in head go with the skin, other meshes with the points nearest to them. Sliders
    and poses that made the face somebody are at rest again: they were of whom it was before.

    :param points: (n, 3) millimetres, of the basis
    :param rig: of joints and shapes; None: as drawn people have them
    """
    parts = face.parts()
    whole = whole_with_others(parts, basis, points)
    report = AuthorNeutral(settled=partial(_at_rest, parts, basis, rig))(face, whole, recipe=recipe or parts.recipe)
    return report.authored, report.warnings


def keep_person(face: Face, content: PersonContent, basis: Basis, *, recipe: Recipe | None = None) -> tuple[str, ...]:
    """Put a person into the section of a face as the bytes of its shape: what was authored.

    Sliders and poses are at rest again, as of `apply_person`.

    :raises InputError: a basis that a stage can't be read with: another than the built-in head's
    """
    if basis is not head_basis():
        raise InputError(face.where, f"a section on {basis.name}, expected a person on {head_basis().name}")
    parts = face.parts()
    sliders = tuple(replace(slider, value=None) for slider in parts.sliders)
    kept = head_person_basis(encode_person(replace(content, look=b"", pictures=(), coefficients=b"")))
    return author_changes(
        face, replace(parts, sliders=sliders, person=None, person_basis=kept, photos=(), recipe=recipe or parts.recipe)
    )


def _at_rest(parts: FaceParts, basis: Basis, rig: RigChange | None, changed: FaceParts) -> FaceParts:
    sliders = tuple(replace(slider, value=None) for slider in changed.sliders)
    return replace(settled(parts, changed, basis, rig), sliders=sliders, person=None)
