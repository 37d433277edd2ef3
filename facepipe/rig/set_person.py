"""A face with its person as the neutral: what exports, viewers and hosts deliver (DESIGN section 10)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from facepipe.errors import InputError
from facepipe.parts import FaceParts, Skeleton
from facepipe.rig.build_rig import build
from facepipe.rig.on_person import NewRest, animations_on, limits_on, network_on, sliders_on
from facepipe.rig.person import Person, person_of
from facepipe.rig.rig import Rig
from facepipe.rig.set_error import SetError, set_error
from facepipe.rig.set_mesh import set_mesh

FloatArray = npt.NDArray[np.floating]

_FLAT = 1e-12  # of a joint's volume: there is no way back


@dataclass(frozen=True, kw_only=True)
class SetFace:
    """A face as it is delivered."""

    parts: FaceParts  # its rest is the person; shapes, joints and animations play on top
    pose: str  # who that is, for reports
    error: SetError | None  # of expressions on top; None where the person is the template
    stretch: FloatArray | None = None  # (j, 3, 3) that translations of coefficients made for the template take

    def carried(self, coefficients: FloatArray) -> FloatArray:
        """(..., j, 9) bone coefficients made for the template, for this face: a person's scales left the joints."""
        result: FloatArray = np.array(coefficients, dtype=np.float64)
        if self.stretch is not None:
            result[..., :3] = np.einsum("jab,...jb->...ja", self.stretch, result[..., :3])
        return result


def set_face(parts: FaceParts, pose: str = "set") -> SetFace:
    """The face with the person as its rest.

    ``set`` (and the name of a pose) puts the person into points, offsets of shapes, bind and rest transforms, and
    takes its scales off the joints, so that every engine poses them right. With W the joints' worlds under the person,
    a point becomes ``sum_i w_i W_i inverse(bind_i) p`` and an offset follows the linear part of that. Expressions on
    top are exact where a point's joints carry one transform; elsewhere they are off by `SetFace.error`. ``set-joints``
    leaves points, offsets and binds, and moves the rest transforms alone: exact, for engines that keep scaled joints.

    :param pose: ``set``, ``set-joints``, ``rest`` or an animation of the face, whose first sample is the person
    :raises InputError: no such animation, or a person of shapes that the face lacks or who has joints of no size
    :raises TopologyError: indices and counts that don't fit
    """
    person = person_of(parts, pose)
    if person.is_rest:
        return SetFace(parts=parts, pose=person.description, error=None)
    rig = build(parts)
    rig.weight_vector(person.weights)  # refuses shapes that the face lacks
    _refuse_flat(rig, person, parts.name)
    new = _new_rest(rig, parts.skeleton, person, in_joints=pose == "set-joints")
    moved = None if pose == "set-joints" else rig.blended(rig.skinning_matrices(rig.rest @ person.matrices, np.eye(4)))
    bounds = rig.mesh_offsets
    animations = animations_on(parts, person, new)
    result = replace(
        parts,
        meshes=tuple(
            set_mesh(mesh, person.weights, None if moved is None else moved[bounds[i] : bounds[i + 1]])
            for i, mesh in enumerate(parts.meshes)
        ),
        skeleton=new.skeleton,
        animations=animations,
        played=parts.played if parts.played in {one.name for one in animations} else None,
        sliders=sliders_on(parts, person, new),
        slider_network=network_on(parts, person, new),
        bone_limits=limits_on(parts.bone_limits, person, new),
        person=None,
    )
    where = " in the joints" if pose == "set-joints" else ""
    error = set_error(rig, build(result), person, new, parts, result)
    return SetFace(parts=result, pose=person.description + where, error=error, stretch=new.stretch)


def _refuse_flat(rig: Rig, person: Person, where: str) -> None:
    volumes = np.abs(np.linalg.det(rig.joint_worlds(rig.rest @ person.matrices, np.eye(4))[:, :3, :3]))
    flat = np.flatnonzero(volumes < _FLAT)
    if flat.size:
        what = f"scaled to nothing by the person ({person.description}), expected scales other than 0"
        raise InputError(f"{where} -> {rig.joints[flat[0]]}", what)


def _new_rest(rig: Rig, skeleton: Skeleton, person: Person, *, in_joints: bool) -> NewRest:
    local = rig.rest @ person.matrices
    if in_joints:
        own = np.tile(np.eye(3), (len(local), 1, 1))
        return NewRest(skeleton=replace(skeleton, rest_transforms=local), stretch=own)
    world = rig.joint_worlds(local, np.eye(4))
    before = _stretch(rig.joint_worlds(rig.rest.copy(), np.eye(4)))
    after = _stretch(world)
    stretch = np.linalg.solve(before, after)  # of the person alone, in each joint's own axes
    unscaled = world.copy()
    unscaled[:, :3, :3] = world[:, :3, :3] @ np.linalg.inv(stretch)
    above = np.array([np.eye(4) if parent < 0 else unscaled[parent] for parent in rig.parents]).reshape(-1, 4, 4)
    rest = np.linalg.solve(above, unscaled)
    return NewRest(skeleton=replace(skeleton, bind_transforms=unscaled, rest_transforms=rest), stretch=stretch)


def _stretch(worlds: FloatArray) -> FloatArray:
    """(j, 3, 3) symmetric positive stretch K of the linear parts Q K (polar decomposition); mirrors stay in Q."""
    _, scale, Vt = np.linalg.svd(worlds[:, :3, :3])
    return np.asarray((np.swapaxes(Vt, -1, -2) * scale[:, None, :]) @ Vt)
