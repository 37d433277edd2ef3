"""The neutral of a person, with joints, lids, cards and other meshes that follow its points."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from facepipe.core import tokens
from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError, SchemaError
from facepipe.geometry.nearby_points import NearbyPoints
from facepipe.heads.asset import asset
from facepipe.parts import FaceParts, PersonBasis
from facepipe.payload.person import decode_person
from facepipe.verbs.author_neutral import AuthorNeutral
from facepipe.verbs.blend.rigs import rebase_animations
from facepipe.verbs.person_basis import Basis, head_basis, is_head
from facepipe.verbs.person_rig import RigChange, in_centimetres, own_rests
from facepipe.verbs.whole_faces import NEXT_MM, whole_points


def with_section(parts: FaceParts, where: str) -> FaceParts:
    """As `facepipe.rig.identity.Neutrals` says."""
    basis = _known_basis(parts, where)
    section = b"" if parts.person_basis is None else parts.person_basis.section
    trail = f"{where}.{tokens.PERSON_SECTION}"
    content = decode_person(section, trail)
    return with_neutral(parts, basis, basis.rebuilt(content, trail), basis.rig_change(content))


def with_modes(parts: FaceParts, weights: Mapping[int, float]) -> FaceParts:
    """As `facepipe.rig.identity.Neutrals` says."""
    basis = _known_basis(parts, parts.name)
    points = whole_points(basis.known(parts, parts.name)) + mode_moves(basis, weights, parts.name)
    rests = own_rests(parts) if in_centimetres(parts) else None
    rig = None if rests is None else RigChange(rests=rests, shapes=np.eye(3))
    return with_neutral(parts, basis, points, rig)


def mode_moves(basis: Basis, weights: Mapping[int, float], where: object) -> FloatArray:
    """(n, 3) millimetres by which weights of modes move points; balls go as wholes, which keeps them round.

    :raises InputError: a mode that the basis lacks
    """
    largest = max(weights, default=0)
    if largest >= len(basis.modes):
        raise InputError(where, f"mode {largest} of a slider, expected 0 to {len(basis.modes) - 1} of {basis.name}")
    rows = list(weights)
    moves = np.tensordot(np.array([weights[row] for row in rows]), basis.modes[rows], axes=1)
    for part in basis.rigid:
        if not part.with_modes:
            arms = basis.mean[part.rows] - basis.mean[part.rows].mean(axis=0)
            own = moves[part.rows]
            moves[part.rows] = own.mean(axis=0) + (own * arms).sum() / (arms**2).sum() * arms
    return np.asarray(moves)


def with_neutral(parts: FaceParts, basis: Basis, points: FloatArray, rig: RigChange | None = None) -> FaceParts:
    """The face with points (n, 3) of the basis, millimetres, in place of its own.

    Joints, lids, and cards of the built-in head go with the skin, other meshes with the points nearest to them.

    :param rig: of joints and shapes of the built-in head; None: as drawn people have them
    """
    changed = AuthorNeutral().changed(parts, whole_with_others(parts, basis, points))
    return settled(parts, replace(changed, photos=parts.photos), basis, rig)


def settled(parts: FaceParts, changed: FaceParts, basis: Basis, rig: RigChange | None = None) -> FaceParts:
    """A face with new points, whose joints, shapes, lids and cards go with them."""
    if basis is not head_basis() or not in_centimetres(parts):
        return changed
    from facepipe.heads import assembly

    if parts.skeleton.joints == asset().joints:
        # where a drawn person's are, and not where the template's were carried: up to 8 mm apart, 1.4 of a pose
        body = np.concatenate([mesh.points for mesh in changed.meshes[: len(asset().parts)]])
        own = assembly.skeleton(body)
        own = own if rig is None else rig.skeleton(own)
        joints = replace(parts.skeleton, bind_transforms=own.bind_transforms, rest_transforms=own.rest_transforms)
        animations = rebase_animations(parts.animations, parts.skeleton, joints)
        changed = replace(changed, skeleton=joints, animations=animations)
    return assembly.settled(parts, changed if rig is None else rig.turned(changed))


def whole_with_others(parts: FaceParts, basis: Basis, points: FloatArray) -> FloatArray:
    """(n, 3) whole points of a face whose meshes of the basis are at `points`; the others go with these."""
    before, beside = whole_points(parts), Beside.of(parts, basis)
    whole = before + beside.of_all(points - before[beside.known])
    whole[beside.known] = points
    return whole


@dataclass(frozen=True)
class Beside:
    """Whole points of a face: those of its basis's meshes, and others, which go with them."""

    known: IntArray  # (m,) in the basis's order
    others: IntArray
    near: NearbyPoints | None  # of the known ones

    @classmethod
    def of(cls, parts: FaceParts, basis: Basis) -> Beside:
        """As a face is authored."""
        whole = whole_points(parts)
        cuts = np.cumsum([0, *(len(mesh.points) for mesh in parts.meshes)])
        rows = {mesh.name: np.arange(*cuts[i : i + 2]) for i, mesh in enumerate(parts.meshes)}
        known = np.concatenate([rows[name] for name in basis.topology.names])
        others = np.setdiff1d(np.arange(len(whole)), known)
        near = NearbyPoints.of(whole[others], whole[known], NEXT_MM) if len(others) else None
        return cls(known, others, near)

    def of_all(self, moves: FloatArray) -> FloatArray:
        """(n, 3) moves of all points, where those of the basis's meshes are (m, 3)."""
        whole = np.zeros((len(self.known) + len(self.others), 3))
        whole[self.known] = moves
        if self.near is not None:
            whole[self.others] = self.near.carried(moves)
        return whole


def head_person_basis(section: bytes = b"") -> PersonBasis:
    """That of the built-in head, as a face has it."""
    return PersonBasis(name=head_basis().name, digest=head_basis().digest.hex(), section=section)


def _known_basis(parts: FaceParts, where: str) -> Basis:
    """The basis of a face.

    :raises SchemaError: none that is known, or one of other faces
    """
    own, basis = parts.person_basis, head_basis()
    if own is None or own.digest != basis.digest.hex():
        found = "none" if own is None else f"{own.digest[:32]} ({own.name[:60]})"
        trail = f"{where} -> {tokens.PERSON_DIGEST}"
        raise SchemaError(trail, f"{found}, expected {basis.digest.hex()} of {basis.name}, the basis that is known")
    if not is_head(parts, where):
        raise SchemaError(where, f"a person relative to {basis.name}, expected its meshes")
    return basis
