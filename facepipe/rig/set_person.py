"""A face with its person as the neutral: what exports, viewers and hosts deliver (DESIGN section 10)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.parts import FaceParts
from facepipe.rig.bone_coefficients import coefficient_matrices, rest_coefficients
from facepipe.rig.build_rig import build
from facepipe.rig.person import Person, person_of
from facepipe.rig.rig import Rig
from facepipe.rig.sliders import slide

if TYPE_CHECKING:
    from facepipe.rig.on_person import NewRest

_FLAT_SIZE = 1e-12  # of a joint's size, in one direction beside the others: there is no way back
POSES = 50
_POSE_TURN = 0.2  # radians
_POSE_MOVE_MM = 1.0
_SHAPES_A_POSE = 3  # on in each pose
_POSE_SEED = 0


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
    :raises InputError: no such animation, a person of shapes that the face lacks, or joints of no size, at rest or with
        the person
    :raises TopologyError: indices and counts that don't fit
    """
    person = person_of(parts, pose)
    if person.is_rest:
        return SetFace(parts=parts, pose=person.description, error=None)
    return _set_face(parts, person, in_joints=pose == "set-joints")


def _set_face(parts: FaceParts, person: Person, *, in_joints: bool) -> SetFace:
    from facepipe.rig.on_person import animations_on, limits_on, network_on, new_rest, sliders_on
    from facepipe.rig.set_mesh import set_mesh

    rig = build(parts)
    rig.weight_vector(person.weights)  # refuses shapes that the face lacks
    _refuse_flat(rig, person, parts.name)
    new = new_rest(rig, parts.skeleton, person, in_joints=in_joints)
    moved = None if in_joints else rig.blended(rig.skinning_matrices(rig.rest @ person.matrices, np.eye(4)))
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
        played=parts.played if parts.played in {animation.name for animation in animations} else None,
        sliders=sliders_on(parts, person, new),
        slider_network=network_on(parts, person, new),
        bone_limits=limits_on(parts.bone_limits, person, new),
        person=None,
    )
    where = " in the joints" if in_joints else ""
    error = set_error(rig, build(result), person, new, parts, result)
    return SetFace(parts=result, pose=person.description + where, error=error, stretch=new.stretch)


def _refuse_flat(rig: Rig, person: Person, where: str) -> None:
    by_person = f"by the person ({person.description})"
    for local, who in ((rig.rest, "at rest"), (rig.rest @ person.matrices, by_person)):
        worlds = rig.joint_worlds(local.copy(), np.eye(4))[:, :3, :3]
        finite = np.asarray(np.isfinite(worlds).all(axis=(1, 2)))
        sizes = np.linalg.svd(np.where(finite[:, None, None], worlds, 0.0), compute_uv=False)
        large = ~finite | (sizes[:, 0] > 1.0 / _FLAT_SIZE)
        flat = np.flatnonzero(large | (sizes[:, 2] < _FLAT_SIZE * np.maximum(sizes[:, 0], 1.0)))
        if flat.size:
            what = f"scaled {'beyond measure' if large[flat[0]] else 'to nothing'} {who}, expected scales near 1"
            raise InputError(f"{where} -> {rig.joints[flat[0]]}", what)


@dataclass(frozen=True, kw_only=True)
class SetError:
    """Distances between points in mm, over all shapes at 1 and random poses of all joints within their limits."""

    mean_mm: float  # of the points' largest distances
    max_mm: float
    shapes: int
    poses: int
    sliders_max_mm: float  # over random settings of the sliders, within their ranges; 0 without sliders


def set_error(before: Rig, after: Rig, person: Person, new: NewRest, parts: FaceParts, result: FaceParts) -> SetError:
    """Compare both rigs, each shape at 1 and each pose of joints and shapes on top of the person.

    :param parts: that `before` was built of
    :param result: that `after` was built of
    """
    largest = np.zeros(len(before.points))
    shapes = [({name: 1.0}, rest_coefficients(len(before.joints))) for name in before.shapes]
    poses = random_poses(before, parts)
    for weights, expression in [*shapes, *poses]:
        together = person.weights_under(weights)
        exact = before.evaluate(together, joint_transforms=before.rest @ person.under(expression))
        # new joints lack the person's scales, which stretched an expression's translations: `carried` makes up for it
        moved = after.evaluate(weights, joint_transforms=after.rest @ new.carried(coefficient_matrices(expression)))
        np.maximum(largest, np.linalg.norm(moved - exact, axis=1), out=largest)
    largest *= 1000 * parts.meters_per_unit
    return SetError(
        mean_mm=float(largest.mean()) if len(largest) else 0.0,
        max_mm=float(largest.max(initial=0.0)),
        shapes=len(shapes),
        poses=len(poses),
        sliders_max_mm=1000 * parts.meters_per_unit * _sliders_apart(before, after, parts, result),
    )


def _sliders_apart(before: Rig, after: Rig, parts: FaceParts, result: FaceParts) -> float:
    """Largest distance between points under the same slider values, in stage units."""
    random, farthest = np.random.default_rng(_POSE_SEED), 0.0
    for _ in range(POSES if parts.sliders else 0):
        values = {slider.name: float(random.uniform(slider.minimum, slider.maximum)) for slider in parts.sliders}
        exact, moved = (
            rig.evaluate(weights, coefficients=coefficients)
            for rig, (coefficients, weights) in (
                (before, slide(parts.sliders, before.joints, values, parts.slider_network)),
                (after, slide(result.sliders, after.joints, values, result.slider_network)),
            )
        )
        farthest = max(farthest, float(np.linalg.norm(moved - exact, axis=1).max(initial=0.0)))
    return farthest


def random_poses(rig: Rig, parts: FaceParts) -> list[tuple[dict[str, float], FloatArray]]:
    """Shape weights and bone coefficients (j, 9) of random poses: up to 0.2 radians and 1 mm within the limits."""
    random = np.random.default_rng(_POSE_SEED)
    reach = np.zeros(9)
    reach[:3], reach[3:6] = _POSE_MOVE_MM / (1000 * parts.meters_per_unit), _POSE_TURN
    rest = rest_coefficients(len(rig.joints))
    low, high = rest - reach, rest + reach
    if parts.bone_limits is not None:
        low, high = np.maximum(low, parts.bone_limits.lower), np.minimum(high, parts.bone_limits.upper)
        low, high = np.minimum(low, rest), np.maximum(high, rest)
    poses: list[tuple[dict[str, float], FloatArray]] = []
    for _ in range(POSES):
        chosen = random.permutation(len(rig.shapes))[:_SHAPES_A_POSE]
        weights = {rig.shapes[i]: float(random.random()) for i in chosen}
        poses.append((weights, low + random.random(rest.shape) * (high - low)))
    return poses
