"""A face that a neural rig moves: its controls are sliders, its hidden layer their network, its basis blendshapes."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from facepipe.errors import TopologyError
from facepipe.options import check_ranges
from facepipe.parts import Blendshape, FaceParts, Mesh
from facepipe.processors.database import Topology
from facepipe.processors.neural_rig.as_sliders import neural_network, neural_sliders, shape_name
from facepipe.processors.same_topology import MILLIMETRES, check_spaces, world_to_world
from facepipe.rig import build, mesh_spaces
from facepipe.rig.bones import bones_in
from facepipe.rig.neural_basis import reach
from facepipe.rig.neural_rig import NeuralRig

FloatArray = npt.NDArray[np.floating]

_SAME = 2.0**-22  # of the largest coordinate: two roundings to float32
_MATRIX = 1e-3  # millimetres, or of a rotation, by which joints may differ
_WEIGHT = 1e-5  # of a skin weight, float32 and half way between


@dataclass(frozen=True, kw_only=True)
class AttachOptions:
    """What of the shapes is kept."""

    offset_tolerance_mm: float = field(
        default=1e-2,
        metadata={
            "help": "a shape leaves out points that it moves by less than this",
            "range": (0.0, 1.0),
            "unit": "mm",
        },
    )


@dataclass(frozen=True, kw_only=True)
class AttachedNeuralRig:
    """A face with a neural rig in place of its own sliders and shapes."""

    parts: FaceParts
    dropped_mm: float  # by which points can be off for what shapes leave out, with activations from -1 to 1
    offsets: int  # that shapes hold, of all meshes
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class AttachNeuralRig:
    """Puts a neural rig on a face of the meshes that it was learned on.

    Skeleton, regions, landmarks, materials and bone limits stay; sliders, shapes and animations are replaced.
    With bones the joints and skin of the face stay, and must be those of the rig. Without bones what was skinned
    follows the first joint rigidly, so that it isn't skinned twice and still goes with the body; its points are the
    rig's at rest. Shapes are scaled so that their weights stay about within -1..1 over the ranges of the controls.
    """

    options: AttachOptions = field(default_factory=AttachOptions)

    def __call__(self, parts: FaceParts, rig: NeuralRig, where: str) -> AttachedNeuralRig:
        """The face that the rig moves.

        :raises InputError: an option out of range
        :raises TopologyError: other meshes, joints or skin than the rig was learned on, or a singular space
        """
        check_ranges(self.options)
        check_neural_rig(parts, rig, where)
        whole = rig
        rig, scales, moved = _kept(whole, self.options.offset_tolerance_mm)
        meshes, ends = [], np.cumsum([len(mesh.points) for mesh in parts.meshes])
        for mesh, space, end in zip(parts.meshes, _spaces(parts, rig), ends, strict=True):
            own = slice(end - len(mesh.points), end)
            linear = np.linalg.inv(space)[:3, :3]
            shapes = _shapes(rig.shapes[:, own] * scales[:, None, None], moved[:, own], linear)
            meshes.append(_mesh(mesh, rig, rig.rest[own], space, shapes))
        attached = replace(
            parts,
            meshes=tuple(meshes),
            sliders=neural_sliders(parts, rig, scales),
            slider_network=neural_network(parts, rig, scales),
            animations=(),
            photos=tuple(replace(photo, animation=None) for photo in parts.photos),
        )
        return AttachedNeuralRig(
            parts=attached,
            dropped_mm=_left_out(whole, self.options.offset_tolerance_mm),
            offsets=int(moved.sum()),
            warnings=_dropped(parts),
        )


def with_neural_rig(parts: FaceParts, rig: NeuralRig, where: str) -> FaceParts:
    """`AttachNeuralRig` with its default options: the face alone."""
    return AttachNeuralRig()(parts, rig, where).parts


def check_neural_rig(parts: FaceParts, rig: NeuralRig, where: str) -> None:
    """:raises TopologyError: other meshes, joints or skin than the rig was learned on, or a singular space"""
    if Topology.of(parts).digest != rig.topology:
        raise TopologyError(where, "other meshes than the neural rig was learned on, expected their names and faces")
    check_spaces(where, parts)
    if rig.bones is None:
        return
    if parts.skeleton.joints != rig.bones.joints:
        found, expected = len(parts.skeleton.joints), len(rig.bones.joints)
        raise TopologyError(where, f"{found} joints that differ, expected the {expected} that the neural rig moves")
    own = bones_in(build(parts), world_to_world(parts.meters_per_unit, parts.up_axis, MILLIMETRES))
    for name, what in (("rest", "rest transforms"), ("inverse_bind", "bind transforms"), ("parent_world", "place")):
        if not np.allclose(getattr(own, name), getattr(rig.bones, name), rtol=0, atol=_MATRIX):
            raise TopologyError(where, f"{what} of the skeleton differ, expected those that the neural rig moves")
    if abs(own.influences - rig.bones.influences).max() > _WEIGHT:
        raise TopologyError(where, "skin weights differ, expected those that the neural rig moves")


def _spaces(parts: FaceParts, rig: NeuralRig) -> list[FloatArray]:
    """(4, 4) of every mesh from its space to that of the rig's rest points."""
    to = world_to_world(parts.meters_per_unit, parts.up_axis, MILLIMETRES)
    if rig.bones is not None:
        scale = np.cbrt(np.linalg.det(to[:3, :3]))
        return [np.diag([scale, scale, scale, 1.0]) @ space for space in mesh_spaces(parts)]
    skeleton = parts.skeleton
    followed = np.asarray(skeleton.transform, dtype=np.float64)
    carried = followed
    if skeleton.joints:
        carried = followed @ skeleton.rest_transforms[0] @ np.linalg.inv(skeleton.bind_transforms[0])
    return [
        to @ (carried if mesh.skin else followed) @ space
        for mesh, space in zip(parts.meshes, mesh_spaces(parts), strict=True)
    ]


def _kept(rig: NeuralRig, tolerance: float) -> tuple[NeuralRig, FloatArray, npt.NDArray[np.bool_]]:
    """The rig with the shapes that move some point, (r,) their largest activations, and (r, n) whether they move it."""
    scales = reach(rig)[: len(rig.shapes)]
    moved = _moves(rig, scales) > tolerance
    used = moved.any(axis=1)
    outputs = np.concatenate([used, np.ones(len(rig.channels), bool)])
    kept = replace(
        rig,
        shapes=rig.shapes[used],
        linear=rig.linear[:, outputs],
        last=rig.last[outputs],
        last_bias=rig.last_bias[outputs],
    )
    return kept, scales[used], moved[used]


def _moves(rig: NeuralRig, scales: FloatArray) -> FloatArray:
    """(r, n) millimetres that every shape moves every point at its largest activation."""
    return np.asarray(np.linalg.norm(rig.shapes, axis=2) * scales[:, None])


def _left_out(rig: NeuralRig, tolerance: float) -> float:
    """Millimetres, of the point that lacks most, all shapes together."""
    moves = _moves(rig, reach(rig)[: len(rig.shapes)])
    return float(np.where(moves > tolerance, 0.0, moves).sum(axis=0).max(initial=0.0))


def _shapes(offsets: FloatArray, own: npt.NDArray[np.bool_], linear: FloatArray) -> tuple[Blendshape, ...]:
    """Blendshapes of one mesh; those that move none of its points are not on it."""
    found = []
    for number, (all_offsets, moved) in enumerate(zip(offsets, own, strict=True)):
        points = np.flatnonzero(moved).astype(np.int32)
        if len(points):
            moves = all_offsets[points] @ linear.T
            found.append(Blendshape(name=shape_name(number), point_indices=points, offsets=moves))
    return tuple(found)


def _mesh(mesh: Mesh, rig: NeuralRig, rest: FloatArray, space: FloatArray, shapes: tuple[Blendshape, ...]) -> Mesh:
    back = np.linalg.inv(space)
    points, skin = rest @ back[:3, :3].T + back[:3, 3], mesh.skin
    there = np.asarray(mesh.points, dtype=np.float64) @ space[:3, :3].T + space[:3, 3]
    if np.abs(there - rest).max(initial=0.0) <= _SAME * np.abs(rest).max(initial=0.0):
        points = mesh.points  # nothing to author
    if skin is not None and rig.bones is None:
        one = np.ones((len(points), 1), np.float32)
        skin = replace(skin, joint_indices=np.zeros((len(points), 1), np.int32), joint_weights=one)
    return replace(mesh, points=points, skin=skin, blendshapes=shapes)


def _dropped(parts: FaceParts) -> tuple[str, ...]:
    names = [one.name for one in parts.animations]
    return (f"animations are of the rig that is replaced, left out: {', '.join(names)}",) if names else ()
