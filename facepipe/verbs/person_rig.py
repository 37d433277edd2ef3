"""How joints rest and shapes go of people who are not drawn: blends turn both, and joints of scans lie elsewhere.

A payload has it as `PersonRig`. Without it poses of blends by regions are 0.3 to 2.1 mm off, with it as far as points.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.geometry.similarity import fit_similarity
from facepipe.heads import assembly
from facepipe.heads.assembly import LIDS
from facepipe.heads.asset import asset
from facepipe.parts import Blendshape, FaceParts, Inbetween, Skeleton
from facepipe.payload.basis import BasisContent
from facepipe.payload.person_rig import LARGEST_MOVE, LARGEST_STEPS, LARGEST_TURN, PersonRig
from facepipe.rig import mesh_spaces
from facepipe.rig.bone_coefficients import coefficient_matrices, matrix_coefficients
from facepipe.rig.trs import quaternions, rotation_matrices

_Shape = TypeVar("_Shape", Blendshape, Inbetween)

MM = 10.0  # in a centimetre, which the built-in head is in
_MOVE, _TURN = 0.1, 0.0005  # millimetres and radians of a step: of poses 0.002 mm, where 0.2 and 0.002 leave 0.013
_WORTH = 0.02  # millimetres that shapes or poses are off by on average, below which nothing is sent
_OFF_BY_MOVE, _OFF_BY_TURN = 0.27, 31.0  # millimetres of poses for a millimetre and a radian of all joints, as measured
_FITS = 0.5  # of what shapes are off by: a similarity that leaves more is none that a blend made
_SAME = 1e-3  # millimetres and radians: joints are where points have them


@dataclass(frozen=True, kw_only=True)
class RigChange:
    """What takes joints and shapes as points and basis have them to a person's."""

    rests: FloatArray  # (j, 4, 4) M of each joint along the axes of the world, millimetres
    shapes: FloatArray  # (3, 3) that offsets of shapes are multiplied by, but those of LIDS, which fit the eyeballs

    @classmethod
    def of(cls, rig: PersonRig | None, joints: int) -> RigChange:
        """That of a payload, for a basis of so many joints."""
        rests = np.tile(np.eye(4), (joints, 1, 1))
        if rig is None:
            return cls(rests=rests, shapes=np.eye(3))
        rests[: len(rig.steps)] = coefficient_matrices(rig.coefficients())
        *turn, growth = np.asarray(rig.shapes, np.float64)
        whole = np.append(turn, np.sqrt(max(1.0 - np.square(turn).sum(), 0.0)))
        return cls(rests=rests, shapes=np.exp(growth) * rotation_matrices(whole))

    def worlds(self, places: FloatArray) -> FloatArray:
        """(j, 4, 4) joints at rest, by where points have them, (j, 3) in millimetres."""
        worlds = self.rests.copy()
        worlds[:, :3, 3] += places
        return worlds

    def skeleton(self, drawn: Skeleton) -> Skeleton:
        """That of the built-in head, whose `drawn` one lies along the axes of the world."""
        if np.array_equal(self.rests, np.broadcast_to(np.eye(4), self.rests.shape)):
            return drawn
        worlds = self.worlds(MM * drawn.bind_transforms[:, :3, 3])
        worlds[:, :3, 3] /= MM
        inverses = np.linalg.inv(worlds)
        rests = np.array([worlds[i] if up < 0 else inverses[up] @ worlds[i] for i, up in enumerate(drawn.parents)])
        return replace(drawn, bind_transforms=worlds, rest_transforms=rests)

    def turned(self, parts: FaceParts) -> FaceParts:
        """A face whose shapes are turned."""
        if np.array_equal(self.shapes, np.eye(3)):
            return parts

        def turned(shape: _Shape) -> _Shape:
            return replace(shape, offsets=np.asarray(shape.offsets, np.float64) @ self.shapes.T)

        meshes = []
        for mesh in parts.meshes:
            shapes = (
                one if one.name in LIDS else replace(turned(one), inbetweens=tuple(map(turned, one.inbetweens)))
                for one in mesh.blendshapes
            )
            meshes.append(replace(mesh, blendshapes=tuple(shapes)))
        return replace(parts, meshes=tuple(meshes))


def in_centimetres(parts: FaceParts) -> bool:
    """Whether the built-in head is as it was made, which its lids and cards are fitted as."""
    names = [mesh.name for mesh in parts.meshes[: len(asset().parts)]]
    return names == list(asset().parts) and (parts.meters_per_unit, parts.up_axis) == (0.01, "Y")


def joint_places(basis: BasisContent, points: FloatArray) -> FloatArray:
    """(j, 3) where points (n, 3) have the joints of a basis."""
    places = [joint.shares @ points[joint.points] for joint in basis.joints]
    return np.reshape(np.asarray(places, np.float64), (-1, 3))


def _body(parts: FaceParts) -> FloatArray:
    """(n, 3) points of the meshes of the built-in head, in its own unit."""
    return np.concatenate([np.asarray(mesh.points, np.float64) for mesh in parts.meshes[: len(asset().parts)]])


def own_rests(parts: FaceParts) -> FloatArray | None:
    """(j, 4, 4) what takes joints of the built-in head, in centimetres, from where its points have them to its own;
    None: these are others, or just there.
    """
    if parts.skeleton.joints != asset().joints:
        return None
    rests = np.array(parts.skeleton.bind_transforms, np.float64)
    rests[:, :3, 3] -= assembly.skeleton(_body(parts)).bind_transforms[:, :3, 3]
    rests[:, :3, 3] *= MM
    return None if np.abs(rests - np.eye(4)).max() < _SAME else rests


def rig_of(parts: FaceParts) -> PersonRig | None:
    """The rig of the built-in head; None where its points say enough of it, or it is in another space.

    Joints count where poses are off by more than `_WORTH` on average, shapes where they turn and grow together. Both
    are the neutral's: what sliders and bones make of it moves joints with the points, as of who is drawn.
    """
    if not in_centimetres(parts):
        return None
    spaces = (parts.skeleton.transform, *mesh_spaces(parts)[: len(asset().parts)])
    if not np.allclose(spaces, np.eye(4), atol=_SAME):
        return None
    rests, shapes = own_rests(parts), _own_shapes(parts)
    steps, move, turn = np.zeros((0, 6), np.int64), _MOVE, _TURN
    if rests is not None:
        numbers = matrix_coefficients(rests)[:, :6]
        angles = 2 * np.arccos(np.clip(quaternions(rests[:, :3, :3])[:, 3], 0.0, 1.0))
        off = _OFF_BY_MOVE * np.linalg.norm(numbers[:, :3], axis=1) + _OFF_BY_TURN * angles
        move = _step(np.abs(numbers[:, :3]).max(), _MOVE)
        turn = _step(np.abs(np.diff(numbers[:, 3:], axis=0, prepend=0.0)).max(), _TURN)
        if off.mean() > _WORTH and move <= LARGEST_MOVE and turn <= LARGEST_TURN:
            whole = np.rint(numbers / np.repeat([move, turn], 3)).astype(np.int64)
            whole[:, 3:] = np.diff(whole[:, 3:], axis=0, prepend=0)
            steps = whole[: 1 + np.flatnonzero(whole.any(axis=1)).max(initial=-1)]
    if not len(steps) and shapes is None:
        return None
    return PersonRig(shapes=np.zeros(4, np.float16) if shapes is None else shapes, move=move, turn=turn, steps=steps)


def _step(largest: float, finest: float) -> float:
    """float16 of which LARGEST_STEPS reach so far, one of them for rounding."""
    return float(np.float16(max(finest, 1.01 * largest / (LARGEST_STEPS - 1))))


def _own_shapes(parts: FaceParts) -> FloatArray | None:
    """(4,) float16 of `PersonRig`, of the similarity that takes the package's shapes to a face's; None: none does."""
    skin = next(iter(asset().parts.values()))
    head, before, after = parts.meshes[0], [], []
    for shape in head.blendshapes:
        if shape.name in asset().shapes and shape.name not in LIDS:
            before.append(asset().shapes[shape.name][1.0][skin.points][shape.point_indices])
            after.append(shape.offsets)
    if not before:
        return None
    old, new = (np.concatenate(rows).astype(np.float64) for rows in (before, after))
    off, count = new - old, len(before) * len(head.points)
    if MM * np.linalg.norm(off, axis=1).sum() / count <= _WORTH:
        return None
    found = fit_similarity(np.vstack([old, -old]), np.vstack([new, -new]))
    if np.square(new - found.apply(old)).sum() > _FITS**2 * np.square(off).sum():
        return None
    turn = quaternions(found.rotation)
    return np.append(turn[:3], np.log(found.scale)).astype(np.float16)
