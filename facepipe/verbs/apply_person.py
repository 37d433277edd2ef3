"""A person of a payload as the neutral of a face."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.geometry.nearby_points import NearbyPoints
from facepipe.heads.asset import asset
from facepipe.parts import FaceParts, Recipe
from facepipe.payload.person import PersonContent
from facepipe.stage import Face
from facepipe.verbs.author_neutral import AuthorNeutral
from facepipe.verbs.blend.rigs import rebase_animations
from facepipe.verbs.person_basis import Basis, database_basis, head_basis, is_head, template_basis
from facepipe.verbs.whole_faces import NEXT_MM, whole_points


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
    face: Face, points: FloatArray, basis: Basis, *, recipe: Recipe | None = None
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Put a person's points into the neutral of a face: what was authored, and warnings.

    Joints, lids, and cards of the built-in head go with the skin, other meshes with the points nearest to them. Sliders
    and poses that made the face somebody are at rest again: they were of whom it was before.

    :param points: (n, 3) millimetres, of the basis
    """
    parts = face.parts()
    whole = _with_others(parts, basis, points)
    rest = partial(_at_rest, parts, built_in=basis is head_basis() and _in_centimetres(parts))
    report = AuthorNeutral(settled=rest)(face, whole, recipe=recipe or parts.recipe)
    return report.authored, report.warnings


def _at_rest(parts: FaceParts, changed: FaceParts, *, built_in: bool) -> FaceParts:
    if built_in:
        from facepipe.heads.assembly import settled, skeleton

        if parts.skeleton.joints == asset().joints:
            # where a drawn person's are, and not where the template's were carried: up to 8 mm apart, 1.4 of a pose
            body = np.concatenate([mesh.points for mesh in changed.meshes[: len(asset().parts)]])
            own = skeleton(body)
            joints = replace(parts.skeleton, bind_transforms=own.bind_transforms, rest_transforms=own.rest_transforms)
            animations = rebase_animations(parts.animations, parts.skeleton, joints)
            changed = replace(changed, skeleton=joints, animations=animations)
        changed = settled(parts, changed)
    sliders = tuple(replace(slider, value=None) for slider in changed.sliders)
    return replace(changed, sliders=sliders, person=None)


def _in_centimetres(parts: FaceParts) -> bool:
    """Whether the built-in head is as it was made, which its lids and cards are fitted as."""
    names = [mesh.name for mesh in parts.meshes[: len(asset().parts)]]
    return names == list(asset().parts) and (parts.meters_per_unit, parts.up_axis) == (0.01, "Y")


def _with_others(parts: FaceParts, basis: Basis, points: FloatArray) -> FloatArray:
    """(n, 3) whole points of a face whose meshes of the basis are at `points`; the others go with these."""
    before = whole_points(parts)
    cuts = np.cumsum([0, *(len(mesh.points) for mesh in parts.meshes)])
    rows = {mesh.name: slice(*map(int, cuts[i : i + 2])) for i, mesh in enumerate(parts.meshes)}
    known = np.concatenate([np.arange(rows[name].start, rows[name].stop) for name in basis.topology.names])
    others = np.setdiff1d(np.arange(len(before)), known)
    whole = before.copy()
    whole[known] = points
    if len(others):
        near = NearbyPoints.of(before[others], before[known], NEXT_MM)
        whole[others] += near.carried(points - before[known])
    return whole
